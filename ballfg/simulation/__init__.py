"""Synthetic tracks: a launcher, motion with effects that nobody declares, noisy measurements, truth beside them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
