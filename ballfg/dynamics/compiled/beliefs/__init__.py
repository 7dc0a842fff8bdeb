"""Means and covariances of balls carried ahead in machine code: steps, table edges, mixtures, events on the way."""
