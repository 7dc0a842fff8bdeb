"""Implements `ballfg-bench cameras`."""
