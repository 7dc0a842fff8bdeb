"""What happened to the ball: contacts, hits, rests and bad samples of one track, found before anything is estimated.

`segment` explains a whole track; `Segmenter` does it sample by sample. The model and its numbers are in
docs/derivations/segmentation.md.
"""

from ballfg.estimate.segmentation.batch import segment
from ballfg.estimate.segmentation.events import Event, EventKind
from ballfg.estimate.segmentation.physics import SegmentationPhysics, physics_of
from ballfg.estimate.segmentation.result import Contact, Quality, Rest, Segmentation
from ballfg.estimate.segmentation.segmenter import Decision, Segmenter
from ballfg.estimate.segmentation.settings import SegmentationSettings

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
