"""Estimators turn tracks into states; all share one interface and one result type."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
