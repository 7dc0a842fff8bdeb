"""Implements `ballfg-bench speed`."""
