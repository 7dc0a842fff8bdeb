"""Sequence models map observations straight to the rest of a track: an LSTM and a conditional diffusion model."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
