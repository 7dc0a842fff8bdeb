"""Implements `ballfg-bench loop`."""
