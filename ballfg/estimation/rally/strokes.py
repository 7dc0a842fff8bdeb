"""Grows arcs into strokes: flights of a ball in space, through bounces, with the candidates that agree.

A stroke is a chain flight, bounce, flight (two bounces in a service). With bounces at guessed times it is linear in its
unknowns (`bounced_path`), so that many guesses are compared at once. Its score is the logarithm of how much better it
explains the candidates than clutter does.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.observations.bounced_path import LIFT, Paths, Scene, places_of, possible, solved
from ballfg.estimation.observations.ray_path import Rays
from ballfg.estimation.observations.rig import with_ends
from ballfg.estimation.observations.sightings import sighted_track
from ballfg.estimation.rally.arcs import SLOWEST
from ballfg.estimation.rally.field import Field, ends_of
from ballfg.estimation.rally.growth import CANDIDATE, VIEW, all_rated, filled, grown, rated
from ballfg.estimation.segmentation.physics import SegmentationPhysics
from ballfg.tracks.sightings import Sightings
from ballfg.tracks.stamps import written
from ballfg.tracks.track import Track
from ballfg.vision.camera import Camera
from ballfg.vision.detection.detections import Detections

STEP: Final = 0.2
"""Pictures between guessed times of a bounce."""
INSIDE, AHEAD = 3.0, 4.0
"""Pictures before and beyond the last candidate in which a bounce is guessed: an arc may pass a low one."""
WITHIN: Final = 0.04
"""s that each of these pictures stands for at least: for several quick ones together."""
ALIKE: Final = 10.0
"""Misfit above the best guess's, of guesses that are followed."""
FOLLOWED: Final = 4
"""Guesses that are followed of so many pictures, the best one between two: those beside it meet the same candidates."""
LEAST: Final = 4
"""Candidates of a shortened stroke."""
BETWEEN: Final = 0.1
"""s between two bounces of a service, at least: a ball that rests longer on the court is not in play."""
APART: Final = 1e-6
"""s, at least, between a bounce and the first and the last candidate: at one of them it is seen from one side alone."""
CUT: Final = 12
"""Candidates at an end of a stroke that may belong to the next one, or to clutter: seen from behind a player, a flight
goes on smoothly for some pictures after a hit."""
SPEEDS: Final = (2.0, 40.0)
"""m/s, of a stroke in play along the court at least, and of any flight in all at most."""
ROOM: Final = (3.6, 3.6, 5.0)
"""Half lengths and half widths of the court, and half widths above it, in which a ball is in play."""


@dataclass(frozen=True, eq=False)
class Stroke:
    """Candidates `rows` (n,) of one flight with bounces at `times`, s, its path, and its score."""

    rows: Index
    bounces: tuple[float, ...]
    path: Paths
    score: float


@dataclass(frozen=True, eq=False)
class Grower:
    """What strokes are grown in: candidates, the scene with their rays, the camera, and its tvec (n, 3) m for each."""

    field: Field
    scene: Scene
    camera: Camera
    tvec: Array

    @classmethod
    def of(
        cls,
        field: Field,
        times: Array,
        camera: Camera,
        physics: SegmentationPhysics,
        surfaces: Surfaces,
        shift: Array | None = None,
    ) -> "Grower":
        """A grower of the candidates of a field at times (n,) s, seen by a camera without distortion.

        Args: shift: (n, 3) m, where it stood from its place; None: there.
        """
        count, rotation = len(times), camera.rotation
        tvec = camera.tvec - (np.zeros((count, 3)) if shift is None else shift) @ rotation.T
        plane = camera.normalized(field.pixels)
        rays = Rays(
            times,
            np.zeros(count, dtype=np.int64),
            rotation[:2] - plane[..., None] * rotation[2],
            plane * tvec[:, 2:] - tvec[:, :2],
            np.linalg.inv(np.linalg.cholesky(field.covariances)) @ camera.matrix[:2, :2],
            np.column_stack((np.tile(rotation[2], (count, 1)), tvec[:, 2])),
            field.step,
        )
        return cls(field, Scene(rays, physics, surfaces, surfaces.table_height, LIFT), camera, tvec)

    @cached_property
    def _seen(self) -> tuple[Any, ...]:
        """Rays, candidates, scene and view for machine code."""
        field, camera = self.field, self.camera
        found = np.zeros(len(field.frame), dtype=CANDIDATE)
        sizes = (field.sizes, field.common, field.spot)
        own = (field.frame, field.pixels, field.covariances, field.bars, field.usual, *sizes, self.tvec)
        for name, values in zip(CANDIDATE.names or (), own, strict=True):
            found[name] = values
        ends = ends_of(self.scene.surfaces)
        net = np.nan if ends is None else float(ends[0].mean())
        lens = (camera.rotation, camera.matrix[0, 0], camera.matrix[:2, 2])
        seen = (*lens, field.step, field.seen, field.exposure, net, self.scene.physics.radius)
        view = np.array([seen], dtype=VIEW)[0]
        return self.scene.sightings, found, self.scene.numbers, view

    def flown(self, rows: Index, bounces: tuple[float, ...]) -> Stroke:
        """The stroke through some candidates with bounces at some times."""
        one = rated(*self._seen, rows, np.array(bounces))
        path = one.path
        misfit, narrowed = np.array([path.misfit]), np.array([path.narrowed])
        own = (path.vectors[None], path.drag[None], path.covariance[None])
        return Stroke(rows, bounces, Paths(one.times[None], len(bounces), misfit, narrowed, *own), one.score)

    def flights(self, seeds: Sequence[Index]) -> list[Stroke]:
        """The flights without a bounce through the candidates of each seed; those of equal length at once."""
        found, length = dict[int, Stroke](), np.array([len(rows) for rows in seeds])
        for count in np.unique(length):
            some = np.flatnonzero(length == count)
            rows, k = np.stack([seeds[number] for number in some.tolist()]), len(some)
            numbers, paths = np.empty((k, 4)), (np.empty((k, 3, 3)), np.empty((k, 1)), np.empty((k, 9, 9)))
            all_rated(*self._seen, rows, numbers, *paths)
            for number, row in zip(some.tolist(), range(k), strict=True):
                one = slice(row, row + 1)
                own = (numbers[one, 2], numbers[one, 3], *(array[one] for array in paths))
                found[number] = Stroke(rows[row], (), Paths(numbers[one, 1:2], 0, *own), float(numbers[row, 0]))
        return [found[number] for number in range(len(seeds))]

    def plausible(self, stroke: Stroke) -> bool:
        """True for a ball in play: its speed, its place at a court with known ends, its bounces, seen on both sides."""
        times = self.scene.rays.times[stroke.rows]
        if stroke.bounces and not times[0] + APART < stroke.bounces[0] <= stroke.bounces[-1] < times[-1] - APART:
            return False
        if stroke.bounces and not possible(self.scene, stroke.path)[0]:
            return False
        if (np.diff(stroke.bounces) < BETWEEN).any():
            return False
        ends = ends_of(self.scene.surfaces)
        if not self._moves(stroke, along=self.field.play and ends is not None):
            return False
        if ends is None:
            return True
        positions, spread = places_of(self.scene, stroke.path, 0, times)
        half, middle = 0.5 * (ends[:, 1] - ends[:, 0]), ends.mean(axis=1)
        table, floor = self.scene.surfaces.table_height, self.scene.surfaces.floor_height
        floor = table - half[1] if floor is None else floor
        low = np.append(middle - half * ROOM[:2], floor)
        high = np.append(middle + half * ROOM[:2], table + ROOM[2] * half[1])
        slack = 2.0 * np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
        return bool(((positions > low - slack) & (positions < high + slack)).all())

    def _moves(self, stroke: Stroke, *, along: bool) -> bool:
        """True if a stroke is as fast as a ball; along: along the court, else by any speed that it may have.

        A tiny flight just before the camera, slow and carried by lift, would explain anything.
        """
        velocities = stroke.path.vectors[0, 1 : stroke.path.bounces + 2]
        speeds = np.linalg.norm(velocities, axis=1)
        fastest = int(np.argmax(speeds))
        if along:
            return bool(np.abs(velocities[:, 0]).max() > SPEEDS[0] and speeds[fastest] < SPEEDS[1])
        part = slice(3 * (fastest + 1), 3 * (fastest + 2))
        sigma = float(np.sqrt(np.linalg.eigvalsh(stroke.path.covariance[0, part, part])[-1]))
        return bool(speeds[fastest] + 2.0 * sigma > SLOWEST and speeds[fastest] < SPEEDS[1])

    def _grown(self, rows: Index, bounces: tuple[float, ...], way: int) -> list[Index]:
        """The candidates of one or two strokes that go on after those of a stroke (way 1) or before them (-1)."""
        rays, candidates, *seen = self._seen
        careful, best = grown(rays, candidates, self.field.first, *seen, rows, np.array(bounces), way)
        return [careful] if len(best) == len(careful) else [careful, best]

    def whole(self, stroke: Stroke) -> list[Stroke]:
        """The strokes that a stroke grows to on both sides, with the candidates between its own, likeliest first."""
        rays, candidates, *seen = self._seen
        times, ended = stroke.bounces, self._grown(stroke.rows, stroke.bounces, 1)
        both = [rows for after in ended for rows in self._grown(after, times, -1)]
        full = [filled(rays, candidates, self.field.first, *seen, rows, np.array(times)) for rows in both]
        return sorted((self.flown(rows, times) for rows in full), key=lambda one: -one.score)

    def bounced(self, stroke: Stroke, way: int) -> Iterator[Stroke]:
        """The stroke with a bounce after its last candidate (way 1) or before its first (-1), and what follows it."""
        times = self.scene.rays.times[stroke.rows]
        end = times[-1] if way > 0 else times[0]
        more = max(1, int(WITHIN / self.field.step + 1e-6))
        steps = more * np.arange(-INSIDE, AHEAD, STEP) * self.field.step
        guesses = end + way * steps
        known = np.array(stroke.bounces)
        guesses = guesses[np.abs(guesses[:, None] - known).min(axis=1, initial=np.inf) > 2.0 * self.field.step]
        if not len(guesses):
            return
        together = np.sort(np.concatenate((np.tile(known, (len(guesses), 1)), guesses[:, None]), axis=1), axis=1)
        tried = solved(self.scene, together, together.shape[1], stroke.rows[None], wide=False)
        passed = np.floor(np.maximum(way * (guesses - end), 0.0) / self.field.step)  # pictures without a candidate
        misfit = tried.misfit - 2.0 * np.log(1.0 - self.field.seen) * passed
        misfit = np.where(possible(self.scene, tried), misfit, np.inf)
        order = np.argsort(misfit, kind="stable")
        _, best = np.unique(
            np.floor((guesses[order] - end) / self.field.step), return_index=True
        )  # between two pictures
        for row in order[np.sort(best)[: more * FOLLOWED]]:
            if misfit[row] > misfit.min() + ALIKE or not np.isfinite(misfit[row]):
                return
            bounces = tuple(together[row].tolist())
            yield from (self.flown(rows, bounces) for rows in self._grown(stroke.rows, bounces, way))

    def shortened(self, stroke: Stroke, most: int = CUT) -> Iterator[Stroke]:
        """The stroke without its last or its first one to `most` candidates, as long as enough are left."""
        for count in range(1, min(most, len(stroke.rows) - LEAST) + 1):
            for rows in (stroke.rows[:-count], stroke.rows[count:]):
                times = self.scene.rays.times[rows]
                inside = tuple(time for time in stroke.bounces if times[0] < time < times[-1])
                yield self.flown(rows, inside)

    def timed(self, stroke: Stroke) -> Stroke:
        """The stroke with each bounce at the time that fits best, a picture earlier or later at most."""
        for number in range(len(stroke.bounces)):
            shifts = np.arange(-1.0, 1.01, 0.1) * self.field.step
            times = np.tile(stroke.bounces, (len(shifts), 1))
            times[:, number] += shifts
            tried = solved(self.scene, times, len(stroke.bounces), stroke.rows[None], wide=False)
            misfit = np.where(possible(self.scene, tried), tried.misfit, np.inf)
            if misfit.min() < stroke.path.misfit[0]:
                stroke = self.flown(stroke.rows, tuple(times[int(np.argmin(misfit))].tolist()))
        return stroke


def track_of(stroke: Stroke, seen: Detections, camera: Camera, model: BallModel, surfaces: Surfaces) -> Track:
    """A stroke as a track of sightings with known bounces, and with the radii that the candidates have."""
    rows = stroke.rows
    parts = np.zeros(len(rows), dtype=np.int64), seen.times[rows], seen.pixels[rows], seen.covariances[rows]
    bounces = written(stroke.bounces, float(seen.frames[0])) - camera.time_offset
    way = np.nan_to_num(seen.streaks[rows, 1] - seen.streaks[rows, 0])
    shifts = None if seen.shifts is None else seen.shifts[seen.frame[rows]]
    sightings = with_ends(Sightings((camera.name,), *parts, seen.radii_of(rows), way, shifts), [camera])
    return sighted_track("stroke", sightings, [camera], model=model, surfaces=surfaces, bounces=bounces)
