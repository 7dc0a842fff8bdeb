"""Factor graphs over one track: factors evaluated in batches, the solver, covariances, the bridge to GTSAM.

docs/custom_factors.md is the contract of a batch; docs/derivations/smoother.md has the objective and its minimisation.
"""
