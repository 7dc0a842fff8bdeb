"""A user's own files to a dataset: columns, units, axes, table and shots are guessed, shown and written."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
