"""Learning from data: the coefficients of the analytic model, calibrated on a dataset of tracks.

`ballfg-train` is its command; docs/train.md is its guide.
"""
