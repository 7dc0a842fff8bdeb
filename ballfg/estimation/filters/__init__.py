"""The extended Kalman filter with its backward pass, and the sliding-window mean."""
