"""Calibration of a model's coefficients on a population of tracks."""
