"""The linear subproblem of a minimisation: a step, and the covariances at its end."""
