"""Balls as they fly: a tracker that tells several apart, sources of their positions, and what `ballfg live` writes."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
