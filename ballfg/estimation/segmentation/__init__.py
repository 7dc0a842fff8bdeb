"""The segmentation finds contacts, hits, rests and bad samples of one track before its estimation.

`segment` explains a whole track; `Segmenter` does it sample by sample. The model and its numbers are in
docs/derivations/segmentation.md.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
