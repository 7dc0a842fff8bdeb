"""Noise that the tracks of a dataset show: of the tracker, of the motion, of bounces, labels and spins."""
