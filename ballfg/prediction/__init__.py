"""Where the ball will be: rollouts, the apex, the next contact, a plane - with covariance."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
