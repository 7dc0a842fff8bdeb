"""How a ball moves: the contract, physical effects, learned models, exact contacts, rollouts, model files."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
