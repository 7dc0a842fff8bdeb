"""Makes pages and pictures: self-contained HTML files, figures for papers, recordings for a viewer."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
