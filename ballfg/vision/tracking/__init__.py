"""Tracks balls from recordings to a dataset, with pictures for checking it."""
