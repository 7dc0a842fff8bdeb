"""Inverts measurement effects and estimates the noise of positions."""
