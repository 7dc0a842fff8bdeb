"""Follows balls in real time: a tracker of several balls, sources of positions, and the output of `ballfg live`."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
