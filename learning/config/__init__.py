"""Defines the configs of a training and of a calibration, and reads their file."""
