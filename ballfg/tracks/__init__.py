"""Tracks and datasets are read, checked and written here; docs/tracks.md describes the files."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
