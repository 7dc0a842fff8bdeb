"""Learning: models trained through the estimator, calibration of coefficients, `ballfg-train`.

`ballfg-train` is its command; docs/train.md is its guide.
"""
