"""Simulates tracks: a launcher, motion with undeclared effects, noisy measurements, and the true states."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
