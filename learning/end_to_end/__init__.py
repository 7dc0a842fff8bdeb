"""Trains models through the estimator."""
