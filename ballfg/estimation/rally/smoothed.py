"""Smooths the strokes of a rally as one graph: flights, bounces and hits in which the ball's place stays the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.observations.bounced_path import place_prior
from ballfg.estimation.observations.sightings import CameraSightings
from ballfg.estimation.rally.strokes import Grower, Stroke
from ballfg.estimation.result import Estimate
from ballfg.estimation.segmentation.result import Contact, Quality, Segmentation
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.tracks.sightings import Sightings
from ballfg.tracks.track import Track
from ballfg.vision.camera import Camera

KINK: Final = 2.0
"""px, standard deviation of the middle of a bar in which the ball bounced."""
WIDE: Final = 0.3
"""m, standard deviation of the first positions of the search."""


class RallySightings(CameraSightings):
    """The sightings of strokes in a row, with their bounces and the hits between them as known events."""

    hits: tuple[int, ...] = ()

    def starts(self, track: Track, model: BallModel, surfaces: Surfaces) -> tuple[Track, ...]:
        """The track itself: its positions are those of the strokes."""
        return (track,)

    def loosened(self, track: Track) -> Track | None:
        """None: the strokes' positions are a start that is good enough."""
        return None

    def segmentation(self) -> Segmentation:
        """The bounces and hits."""
        none = np.zeros(0, dtype=np.int64)
        good = np.full(int(self.state.max()) + 1, Quality.GOOD, dtype=np.int8)
        return Segmentation(self.bounces, np.array(self.hits, dtype=np.int64), none, (), good)


def rally_track(name: str, strokes: Sequence[Stroke], grower: Grower, camera: Camera, stamps: Array) -> Track:
    """The track of strokes in a row, each joined by a hit to the one before.

    Args: camera: the grower's, with its covariance.  stamps: (n,) s, of all candidates.
    """
    rows = np.concatenate([stroke.rows for stroke in strokes])
    times = stamps[rows]
    shift = grower.rays.times[rows[0]] - times[0]
    positions = np.concatenate([grower.places(stroke.path, grower.rays.times[stroke.rows])[0][0] for stroke in strokes])
    bounces = np.array([time for stroke in strokes for time in stroke.bounces]) - shift
    covariances = grower.field.covariances[rows].copy()
    half = 0.5 * grower.field.exposure * grower.field.step
    kinked = (np.abs(times[:, None] - bounces) < half).any(axis=1)
    covariances[kinked] += KINK**2 * np.eye(2)
    count, height = len(rows), grower.surfaces.table_height
    seen = Sightings((camera.name,), np.zeros(count, dtype=np.int64), times, grower.field.pixels[rows], covariances)
    intervals = np.clip(np.searchsorted(times, bounces, side="right") - 1, 0, count - 2)
    contacts = tuple(
        Contact(int(i), float(time - times[0]), height) for i, time in zip(intervals, bounces, strict=True)
    )
    own = RallySightings(
        seen, (camera,), np.arange(count), np.zeros(count), np.zeros(1), True, contacts, place_prior(grower.surfaces)
    )
    own.hits = tuple((np.cumsum([len(stroke.rows) for stroke in strokes[:-1]]) - 1).tolist())
    return Track(times, positions, np.full((count, 3), WIDE), {}, observations=(own,), rough=True, name=name)


def smoothed(track: Track, smoother: Smoother) -> Estimate:
    """The estimate of a track of `rally_track`."""
    return replace(smoother.estimate(track), name=track.name)
