"""Factor graphs over one track: kinds of factors evaluated in batches, the solver, covariances, the bridge to GTSAM.

docs/custom_factors.md is the contract of a kind; docs/derivations/smoother.md has the objective and its minimisation.
"""
