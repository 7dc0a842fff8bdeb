"""Estimates noise from the tracks of a dataset: of the tracker, the motion, bounces, labels and spins."""
