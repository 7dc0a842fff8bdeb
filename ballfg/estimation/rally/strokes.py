"""Grows arcs into strokes: flights of a ball in space, through bounces, with the candidates that agree.

A stroke is a chain flight, bounce, flight (two bounces in a service). With bounces at guessed times it is linear in its
unknowns (`bounced_path`), so that many guesses are compared at once. Its score is the logarithm of how much better it
explains the candidates than clutter does.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.special import ndtr

from ballfg.arrays import Array, Index
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.observations.bounced_path import LIFT, Paths, Scene, narrowed, possible, shares_of, solved
from ballfg.estimation.observations.ray_path import Rays
from ballfg.estimation.rally.field import Field
from ballfg.estimation.segmentation.physics import SegmentationPhysics
from ballfg.state import Z
from ballfg.vision.camera import Camera

SHORT: Final = 0.4
"""Of a picture's time, over which a path shows its motion."""
MISSED, RARE = 3, 0.02
"""Pictures that a flight may pass without a candidate, at least; more, as long as that is not rarer than this."""
GATE: Final = 12.0
"""Squared Mahalanobis distance of a candidate from where it is foretold."""
BOUNCE: Final = 2.0
"""Logarithm of what a bounce costs: its time is free."""
UNBOUNCED: Final = 4.0
"""The same of a stroke without a bounce, and of a second bounce."""
STEP: Final = 0.2
"""Pictures between guessed times of a bounce."""
INSIDE, AHEAD = 3.0, 4.0
"""Pictures before and beyond the last candidate in which a bounce is guessed: an arc may pass a low one."""
ALIKE: Final = 10.0
"""Misfit above the best guess's, of guesses that are followed."""
FOLLOWED: Final = 4
"""Guesses that are followed, the best one between two pictures: those beside it meet the same candidates."""
OTHER_HALF: Final = 5.0
"""The same of a bounce on the half on which it scores for nobody: a stroke bounces on the other player's, a service on
its own first."""
LEAST: Final = 4
"""Candidates of a shortened stroke."""
BETWEEN: Final = 0.1
"""s between two bounces of a service, at least: a ball that rests longer on the court is not in play."""
CUT: Final = 12
"""Candidates at an end of a stroke that may belong to the next one, or to clutter: seen from behind a player, a flight
goes on smoothly for some pictures after a hit."""
SPEEDS: Final = (2.0, 40.0)
"""m/s, of a stroke, along the court at least and in all at most."""
TOGETHER: Final = 2000
"""Flights that are solved at once: more take more memory, and no less time."""
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
    """What strokes are grown in: all candidates, their rays, the ball and the court."""

    field: Field
    rays: Rays
    camera: Camera
    physics: SegmentationPhysics
    surfaces: Surfaces

    @classmethod
    def of(cls, field: Field, times: Array, camera: Camera, physics: SegmentationPhysics, surfaces: Surfaces) -> Grower:
        """A grower of the candidates of a field at times (n,) s, seen by a fixed camera without distortion."""
        count, rotation = len(times), camera.rotation
        plane = camera.normalized(field.pixels)
        rays = Rays(
            times,
            np.zeros(count, dtype=np.int64),
            rotation[:2] - plane[..., None] * rotation[2],
            plane * camera.tvec[2] - camera.tvec[:2],
            np.linalg.inv(np.linalg.cholesky(field.covariances)) @ camera.matrix[:2, :2],
            np.tile(np.append(rotation[2], camera.tvec[2]), (count, 1)),
            field.step,
        )
        return cls(field, rays, camera, physics, surfaces)

    def scene(self, rows: Index) -> Scene:
        """The scene with the rays of some candidates (n,) or (k, n)."""
        some = {name: getattr(self.rays, name)[rows] for name in ("times", "camera", "matrix", "target", "root")}
        rays = replace(self.rays, **some, depth_row=self.rays.depth_row[rows])
        return Scene(rays, self.physics, self.surfaces, self.surfaces.table_height, LIFT)

    def flown(self, rows: Index, bounces: tuple[float, ...]) -> Stroke:
        """The stroke through some candidates with bounces at some times."""
        scene = self.scene(rows)
        anchor = bounces or (float(np.median(scene.rays.times)),)
        return self._rated(rows, solved(scene, np.array([anchor]), len(bounces)), 0)

    def flights(self, seeds: Sequence[Index]) -> list[Stroke]:
        """The flights without a bounce through the candidates of each seed; those of equal length at once."""
        found, length = dict[int, Stroke](), np.array([len(rows) for rows in seeds])
        for count in np.unique(length):
            numbers = np.flatnonzero(length == count)
            for some in np.array_split(numbers, -(-len(numbers) // TOGETHER)):
                rows = np.stack([seeds[number] for number in some])
                tried = solved(self.scene(rows), np.median(self.rays.times[rows], axis=1)[:, None], 0)
                scores = self._scores(rows, tried)
                found |= {
                    int(number): Stroke(mine, (), _one(tried, row), float(scores[row]))
                    for row, (number, mine) in enumerate(zip(some, rows, strict=True))
                }
        return [found[number] for number in range(len(seeds))]

    def _rated(self, rows: Index, tried: Paths, row: int) -> Stroke:
        """One of several solutions as a stroke."""
        path = _one(tried, row)
        bounces = tuple(path.times[0].tolist()) if path.bounces else ()
        score = float(self._scores(rows[None], path)[0]) - (self._halves(path) if bounces else 0.0)
        return Stroke(rows, bounces, path, score)

    def _scores(self, rows: Index, tried: Paths) -> Array:
        """(k,) scores of paths through candidates (k, n), but for the halves of the court on which they bounce."""
        frames, moments, count = self.field.frame[rows], self.rays.times[rows], rows.shape[1]
        half = 0.5 * SHORT * self.field.step
        ends = self.foretold(tried, np.concatenate((moments - half, moments + half), axis=1))[0]
        gain = self.field.gain(rows, (ends[:, count:] - ends[:, :count]) / SHORT)
        gain += (frames[:, -1] - frames[:, 0] + 1 - count) * np.log(1.0 - self.field.seen)
        price = BOUNCE * tried.bounces + UNBOUNCED * (tried.bounces != 1) - narrowed(self.scene(rows), tried)
        return np.asarray(gain - 0.5 * tried.misfit - price)

    def _halves(self, path: Paths) -> float:
        """Logarithm of what the halves of the court cost on which a path bounces, as well as these are known."""
        ends = self.surfaces.extent or (0.0, 0.0)
        places, spread = self.places_of(path, path.times[0])
        ahead = (places[:, 0] - 0.5 * (ends[0] + ends[1])) * np.sign(path.vectors[0, 1, 0])
        ahead[: len(ahead) - 1] *= -1.0  # a service bounces on the server's half first
        right = ndtr(ahead / np.sqrt(spread[:, 0, 0]))
        return float(-np.log(right + np.exp(-OTHER_HALF) * (1.0 - right)).sum())

    def places(self, path: Paths, moments: Array) -> tuple[Array, Array]:
        """Positions (k, n, 3) m of paths at moments (n,) or (k, n) s, and shares (k, n, c) of their vectors."""
        share, drop = shares_of(
            np.atleast_2d(moments), path.times, path.bounces, path.drag, self.physics.gravity, lift=True
        )
        positions = share @ path.vectors
        positions[..., Z] -= drop
        return positions, share

    def foretold(self, path: Paths, moments: Array) -> tuple[Array, Array]:
        """Pixels (k, n, 2) of paths at moments (n,) or (k, n) s, and their covariances (k, n, 2, 2)."""
        positions, share = self.places(path, moments)
        spread = self._spread(path, share)
        at = positions @ self.camera.rotation.T + self.camera.tvec
        depth = np.maximum(at[..., 2:], 0.1)
        seen = at[..., :2] / depth
        slope = (self.camera.rotation[:2] - seen[..., None] * self.camera.rotation[2]) / depth[..., None]
        slope *= self.camera.matrix[0, 0]
        pixels = self.camera.matrix[0, 0] * seen + self.camera.matrix[:2, 2]
        return pixels, slope @ spread @ slope.swapaxes(-1, -2)

    def _spread(self, path: Paths, share: Array) -> Array:
        """(k, n, 3, 3) m^2, covariances of positions that are shares (k, n, c) of a path's vectors."""
        joint = path.covariance.reshape(len(share), share.shape[2], 3, share.shape[2], 3)
        return np.asarray(np.einsum("kna,kaibj,knb->knij", share, joint, share))

    def places_of(self, path: Paths, moments: Array) -> tuple[Array, Array]:
        """Positions (n, 3) m of a single path and their covariances (n, 3, 3)."""
        positions, share = self.places(path, moments)
        return positions[0], self._spread(path, share)[0]

    def plausible(self, stroke: Stroke) -> bool:
        """True for a ball in play: its speed, its place, and its bounces on the court, seen on both sides."""
        scene, times = self.scene(stroke.rows), self.rays.times[stroke.rows]
        if stroke.bounces and not times[0] < stroke.bounces[0] <= stroke.bounces[-1] < times[-1]:
            return False
        if stroke.bounces and not possible(scene, stroke.path)[0]:
            return False
        if (np.diff(stroke.bounces) < BETWEEN).any():
            return False
        velocities = stroke.path.vectors[0, 1 : stroke.path.bounces + 2]
        if not (np.abs(velocities[:, 0]).max() > SPEEDS[0] and np.linalg.norm(velocities, axis=1).max() < SPEEDS[1]):
            return False
        positions, spread = self.places_of(stroke.path, scene.rays.times)
        ends = np.array(self.surfaces.extent).reshape(2, 2)
        half, middle = 0.5 * (ends[:, 1] - ends[:, 0]), ends.mean(axis=1)
        floor = -half[1] if self.surfaces.floor_height is None else self.surfaces.floor_height
        low = np.append(middle - half * ROOM[:2], floor)
        high = np.append(middle + half * ROOM[:2], ROOM[2] * half[1])
        slack = 2.0 * np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
        return bool(((positions > low - slack) & (positions < high + slack)).all())

    def grown(self, stroke: Stroke, way: int) -> list[Stroke]:
        """The stroke with further candidates after it (way 1) or before it (-1): as long as they make it likelier.

        A second one goes on with doubtful candidates, to where it is best: few candidates leave a path so wide that one
        more hardly counts, but the next ones do. The less often the ball is seen, the more doubt is allowed.
        """
        missed, frame = 0, int(self.field.frame[stroke.rows[-1 if way > 0 else 0]])
        careful, best, doubtful = stroke, stroke, False
        most = max(MISSED, int(np.log(RARE) / np.log(1.0 - self.field.seen)))
        while missed <= most and 0 <= (frame := frame + way) < len(self.field.first) - 1:
            missed, more = missed + 1, self._with(stroke, self.field.rows(frame))
            if more is None or more.score <= stroke.score + missed * np.log(1.0 - self.field.seen):
                continue
            doubtful |= more.score <= stroke.score
            missed, stroke = 0, more
            best = more if more.score > best.score else best
            careful = careful if doubtful else more
        return [careful] if best is careful else [careful, best]

    def _with(self, stroke: Stroke, here: Index) -> Stroke | None:
        """The stroke with the nearest of a picture's candidates (n,), if one is near."""
        if not len(here):
            return None
        pixels, spread = (array[0, 0] for array in self.foretold(stroke.path, self.rays.times[here[:1]]))
        off = self._distances(here, pixels, spread)
        rows = np.sort(np.append(stroke.rows, here[int(np.argmin(off))]))
        return self.flown(rows, stroke.bounces) if off.min() < GATE else None

    def whole(self, stroke: Stroke) -> list[Stroke]:
        """The strokes that a stroke grows to on both sides, with the candidates between its own, likeliest first."""
        grown = [self._filled(one) for after in self.grown(stroke, 1) for one in self.grown(after, -1)]
        return sorted(grown, key=lambda one: -one.score)

    def _filled(self, stroke: Stroke) -> Stroke:
        """The stroke with the candidates between its own that make it likelier."""
        frames = self.field.frame[stroke.rows]
        for frame in np.setdiff1d(np.arange(frames[0], frames[-1]), frames):
            more = self._with(stroke, self.field.rows(int(frame)))
            stroke = more if more is not None and more.score > stroke.score else stroke
        return stroke

    def _distances(self, here: Index, pixels: Array, spread: Array) -> Array:
        """(n,) squared Mahalanobis distances of candidates from a foretold pixel (2,)."""
        off = self.field.pixels[here] - pixels
        return np.asarray(np.einsum("na,nab,nb->n", off, np.linalg.inv(self.field.covariances[here] + spread), off))

    def bounced(self, stroke: Stroke, way: int) -> Iterator[Stroke]:
        """The stroke with a bounce after its last candidate (way 1) or before its first (-1), and what follows it."""
        times = self.rays.times[stroke.rows]
        end = times[-1] if way > 0 else times[0]
        steps = np.arange(-INSIDE, AHEAD, STEP) * self.field.step
        guesses = end + way * steps
        known = np.array(stroke.bounces)
        guesses = guesses[np.abs(guesses[:, None] - known).min(axis=1, initial=np.inf) > 2.0 * self.field.step]
        if not len(guesses):
            return
        together = np.sort(np.concatenate((np.tile(known, (len(guesses), 1)), guesses[:, None]), axis=1), axis=1)
        scene = self.scene(stroke.rows)
        tried = solved(scene, together, together.shape[1])
        passed = np.floor(np.maximum(way * (guesses - end), 0.0) / self.field.step)  # pictures without a candidate
        misfit = tried.misfit - 2.0 * np.log(1.0 - self.field.seen) * passed
        misfit = np.where(possible(scene, tried), misfit, np.inf)
        order = np.argsort(misfit, kind="stable")
        _, best = np.unique(
            np.floor((guesses[order] - end) / self.field.step), return_index=True
        )  # between two pictures
        for row in order[np.sort(best)[:FOLLOWED]]:
            if misfit[row] > misfit.min() + ALIKE or not np.isfinite(misfit[row]):
                return
            yield from self.grown(self._rated(stroke.rows, tried, int(row)), way)

    def shortened(self, stroke: Stroke, most: int = CUT) -> Iterator[Stroke]:
        """The stroke without its last or its first one to `most` candidates, as long as enough are left."""
        for count in range(1, min(most, len(stroke.rows) - LEAST) + 1):
            for rows in (stroke.rows[:-count], stroke.rows[count:]):
                times = self.rays.times[rows]
                inside = tuple(time for time in stroke.bounces if times[0] < time < times[-1])
                yield self.flown(rows, inside)

    def timed(self, stroke: Stroke) -> Stroke:
        """The stroke with each bounce at the time that fits best, a picture earlier or later at most."""
        for number in range(len(stroke.bounces)):
            shifts = np.arange(-1.0, 1.01, 0.1) * self.field.step
            times = np.tile(stroke.bounces, (len(shifts), 1))
            times[:, number] += shifts
            scene = self.scene(stroke.rows)
            tried = solved(scene, times, len(stroke.bounces))
            misfit = np.where(possible(scene, tried), tried.misfit, np.inf)
            if misfit.min() < stroke.path.misfit[0]:
                stroke = self._rated(stroke.rows, tried, int(np.argmin(misfit)))
        return stroke


def _one(tried: Paths, row: int) -> Paths:
    """One of several solutions."""
    names = ("times", "misfit", "vectors", "drag", "covariance")
    return replace(tried, **{name: getattr(tried, name)[[row]] for name in names})
