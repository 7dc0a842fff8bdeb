"""Predicts states with covariance: rollouts, the apex, the next contact, the crossing of a plane."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
