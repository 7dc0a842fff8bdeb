"""Films the simulator's balls by cameras over a table, with their true states beside the videos."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
