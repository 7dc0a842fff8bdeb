"""Carries means and covariances of balls ahead in machine code: steps, table edges, mixtures and events."""
