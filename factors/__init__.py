"""Factor graphs over one track: factors evaluated in batches, the solver, covariances, the bridge to GTSAM.

docs/custom_factors.md is the contract of a batch; docs/derivations/smoother.md has the objective and its minimisation.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
