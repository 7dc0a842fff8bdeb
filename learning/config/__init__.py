"""The config of a training or calibration, and what is built from it."""
