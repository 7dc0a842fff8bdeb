"""Runs work in this process, in processes of this machine, or on a cluster; docs/scale.md explains the choice."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
