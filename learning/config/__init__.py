"""The configs of a training and of a calibration, and their file."""
