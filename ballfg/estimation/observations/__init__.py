"""Observations hold measurements of any kind in a form that every estimator uses."""
