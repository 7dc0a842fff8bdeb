"""Solves the linear subproblem of a minimisation: the step, and the covariances at its end."""
