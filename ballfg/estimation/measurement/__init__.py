"""Measurement effects undone, and the noise of positions."""
