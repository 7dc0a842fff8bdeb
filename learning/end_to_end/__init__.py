"""Learning through the estimator."""
