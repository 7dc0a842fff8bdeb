"""Implements `ballfg-bench estimators`."""
