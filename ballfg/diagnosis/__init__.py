"""The diagnosis finds effects that a model of the ball lacks.

`diagnose` runs the whole diagnosis and `write_report` writes its result. The other functions are single steps.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
