"""What happened to the ball: contacts, hits, rests and bad samples of one track, found before anything is estimated.

`segment` explains a whole track; `Segmenter` does it sample by sample. The model and its numbers are in
docs/derivations/segmentation.md.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
