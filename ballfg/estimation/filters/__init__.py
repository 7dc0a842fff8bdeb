"""Filters estimate states sample by sample: the extended Kalman filter and the sliding-window mean."""
