"""Calibrates a model's coefficients on a population of tracks."""
