"""Fits a model jointly to all stretches of a dataset."""
