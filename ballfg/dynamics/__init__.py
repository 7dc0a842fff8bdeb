"""The room of the ball's motion gives models, effects, contacts, rollouts and model files."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
