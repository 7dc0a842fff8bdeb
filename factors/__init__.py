"""Factor graphs describe one track by batches of factors, with a solver, covariances and a bridge to GTSAM.

docs/custom_factors.md is the contract of a batch; docs/derivations/smoother.md has the objective and its minimisation.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
