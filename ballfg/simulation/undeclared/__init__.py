"""What may act although no model declares it: every effect of a model file, and some that no model file can name.

The latter test whether an analysis says "unexplained" where it lacks the explanation.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
