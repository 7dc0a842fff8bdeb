"""Turns camera recordings into tracks: camera models, calibration, detection, association, triangulation."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
