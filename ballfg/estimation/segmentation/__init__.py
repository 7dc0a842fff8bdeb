"""What happened to the ball: contacts, hits, rests and bad samples of one track, found before anything is estimated.

`segment` explains a whole track; `Segmenter` does it sample by sample. The model and its numbers are in
docs/derivations/segmentation.md.
"""

from ballfg.estimation.segmentation.batch import segment
from ballfg.estimation.segmentation.events import Event, EventKind
from ballfg.estimation.segmentation.physics import SegmentationPhysics, physics_of
from ballfg.estimation.segmentation.result import Contact, Quality, Rest, Segmentation
from ballfg.estimation.segmentation.segmenter import Decision, Segmenter
from ballfg.estimation.segmentation.settings import SegmentationSettings

__all__ = [
    "Contact",
    "Decision",
    "Event",
    "EventKind",
    "Quality",
    "Rest",
    "Segmentation",
    "SegmentationPhysics",
    "SegmentationSettings",
    "Segmenter",
    "physics_of",
    "segment",
]
