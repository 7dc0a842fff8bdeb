"""Implements `ballfg-bench dynamics`."""
