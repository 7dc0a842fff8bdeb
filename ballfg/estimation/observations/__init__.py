"""Observations: what was measured, as objects that every estimator knows."""
