"""Learning trains models through the estimator and calibrates coefficients; `ballfg-train` runs it.

docs/learn.md explains the choices, docs/train.md is the guide of the command. The sub-rooms import one way: config and
gradient; run; end_to_end and sequence; calibration.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
