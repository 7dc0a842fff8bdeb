"""Summarises a tracking in words."""

from collections.abc import Iterator

from ballfg.checks import shown
from ballfg.vision.association.agreement import LEAST_MISFIT
from ballfg.vision.tracking.pipeline import Tracking


def summary(tracking: Tracking) -> Iterator[str]:
    """Lines: the detections of each camera, and their use."""
    for number, (camera, seen) in enumerate(zip(tracking.cameras, tracking.detections, strict=True)):
        used = sum(int((ball.sightings.camera == number).sum()) for ball in tracking.balls)
        yield f"  {camera.name}: {len(seen.frames)} frames, {len(seen)} candidates, {used} of them a ball"


def blind_cameras(tracking: Tracking) -> Iterator[str]:
    """A sentence for each camera without a part in any ball, if there are balls."""
    for number, camera in enumerate(tracking.cameras):
        if tracking.balls and not any((ball.sightings.camera == number).any() for ball in tracking.balls):
            yield f"camera {shown(camera.name)} saw none of the balls. Check its stamps, its pose and its candidates."


def disagreement(tracking: Tracking) -> str | None:
    """A sentence on the calibration; None if the cameras agree or too little was seen."""
    found = tracking.agreement
    return found.sentence if found and (found.culprit is not None or found.misfit > LEAST_MISFIT) else None


def no_ball(tracking: Tracking) -> str:
    """One sentence with the best scores of each camera, for a recording in which no ball was found."""
    best = "; ".join(
        f"{seen.camera}: {', '.join(f'{score:.2f}' for score in seen.best_scores()) or 'no candidate'}"
        f" in {len(seen.frames)} frames"
        for seen in tracking.detections
    )
    return f"no ball was found. Best candidates' scores (1 is a ball): {best}."
