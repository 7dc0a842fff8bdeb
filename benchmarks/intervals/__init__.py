"""Measures the coverage of prediction intervals."""
