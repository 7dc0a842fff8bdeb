"""Imports a user's own files as a dataset: it guesses columns, units, axes, table and shots, and shows them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
