"""Cuts flights out of tracks, and gives those of a dataset as a dataset, with what commands say about the rest."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import islice, pairwise, tee
from typing import Final

import numpy as np

from ballfg.arrays import Array, Mask
from ballfg.dynamics.nominal import ready_nominal
from ballfg.estimation.batch import map_tracks
from ballfg.estimation.flights.labels import FEWEST, SHORTEST, Labels, contrasts, label_samples, scatter
from ballfg.estimation.result import Label
from ballfg.estimation.segmentation.physics import SegmentationPhysics, physics_of
from ballfg.parallel.parts import jobs_here
from ballfg.tracks import Dataset, Track
from ballfg.tracks.track import Label as TrackLabel

ENOUGH: Final = 0.5  # Share of the samples in flight below which commands that presume flight refuse
SMOOTHED: Final = 1.35
"""Ratio of the errors over 0.25 s to those from sample to sample beyond which a filter smoothed the positions: on five
measured sets it is at most 1.18, on simulated recordings (seeds 0 to 83) at most 1.08, after a low-pass of 6 Hz at
least 1.58."""
OTHERS: Final = 0.1  # Share of the samples that no motion of the ball explains from which they are worth a doubt
FARTHEST: Final = 0.1  # m. Scatter from sample to sample beyond that of trackers
UNDISTURBED: Final = 0.2  # Quantile of that ratio: stretches with a bounce or a hit have larger ones
SMOOTHING: Final = "a filter smoothed the positions"
OTHER: Final = "of another ball, or outliers"
REPEATED: Final = "a tracker held or rounded them"
REPEATS: Final = (
    f"repeat the one before them: {REPEATED}; leave the repeats out, or velocities lag and sigmas are too small"
)
FILLED: Final = "gaps were filled in"
LINES: Final = (
    f"lie on straight lines, at even speed: {FILLED}; leave those samples out, or the ball seems to fly straight on "
    "there and sigmas are too small"
)
FILLS: Final = 0.01
"""Share of the samples in flight from which filled ones are worth a doubt. No set chose it: `spindoe`, rounded to mm,
has 0.08 %, `robot_rallies` 0.01 %, `aimy`, `ballgun` and `strokes` none."""
EVENLY: Final = 0.5  # m/s^2. Acceleration between samples below which a ball in flight did not move by itself
SPAN: Final = 0.25  # s, of the cubics whose residuals show the errors
LEAST_SPAN: Final = 8  # Samples, likewise
ROUNDING: Final = 2e-4  # m. Errors below are those of rounding, or of the cubics: 0.12 mm where drag is largest
LOOKED_AT: Final = 200  # Number of tracks that show whether a filter smoothed the positions


class FlightsOf(Dataset):
    """The flights of a dataset as a dataset; tracks that only fly are in it as they are."""

    def __init__(self, whole: Dataset, pieces: "dict[str, list[Piece] | None]") -> None:
        self.__dict__.update(whole.__dict__)
        self._whole, self._pieces = whole, pieces

    def __len__(self) -> int:
        return sum(1 if pieces is None else len(pieces) for pieces in self._pieces.values())

    def __iter__(self) -> Iterator[Track]:
        for track in islice(iter(self._whole), len(self._pieces)):
            pieces = self._pieces[track.name]
            if pieces is None:
                yield track
            else:
                yield from tracks_of(track, pieces)

    @property
    def names(self) -> list[str]:
        """The names of the flights, in their order."""
        found = list[str]()
        for name, pieces in self._pieces.items():
            found += [name] if pieces is None else names_of(name, pieces)
        return found

    def track(self, name: str) -> Track:
        """One flight by its name; errors as of a dataset."""
        found = next((track for track in self if track.name == name), None)
        return self._whole.track(name) if found is None else found


@dataclass(frozen=True)
class Contents:
    """What tracks hold.

    Attributes:
        pieces: flights by name of the track; None where a track is used as a whole.
        share: of the samples that are flight, 0 to 1.
        smoothing: ratio of slow to fast errors of the positions; 1 if they are white; NaN if unknown.
        others: sentence on samples that are not of the ball; empty without.
        repeated, filled: sentences on positions that are those of the sample before, or on a line; empty without.
    """

    pieces: "dict[str, list[Piece] | None]"
    share: float
    smoothing: float
    others: str
    repeated: str
    filled: str

    @classmethod
    def of(cls, labelled: Iterable[tuple[Track, Labels]], whole: Callable[[Track, Labels], bool]) -> "Contents":
        """Of labelled tracks. Args: whole: True for a track that is used as a whole."""
        pieces: dict[str, list[Piece] | None] = {}
        ratios, jumps, counts = list[Array](), list[float](), np.zeros(5)
        for track, labels in labelled:
            own = pieces[track.name] = None if whole(track, labels) else pieces_of(labels)
            lost, flight = labels.values == Label.LOST, labels.values == Label.FLIGHT
            same = (np.diff(track.positions, axis=0, prepend=np.nan) == 0.0).all(axis=1)
            evenly = on_lines(track) & ~same & (flight | lost)
            flying = len(track) if own is None else flight.sum()
            counts += (len(track), flying, lost.sum(), (same & flight).sum(), evenly.sum())
            if len(pieces) <= LOOKED_AT:
                ratios.append(error_ratios(track, labels))
                jumps += [float(scatter(track.seconds, track.positions).max())] if len(track) >= FEWEST else []
        samples, flying, lost, again, filled = counts.tolist()
        held = np.concatenate(ratios)
        smoothing = float(np.quantile(held, UNDISTURBED)) if len(held) else np.nan
        share, strange = flying / samples, others(lost / samples, float(np.median(jumps or [0.0])))
        again, filled = again / max(flying, 1.0), filled / max(flying, 1.0)
        not_measured = unmeasured(again, OTHERS, REPEATS), unmeasured(filled, FILLS, LINES)
        return cls(pieces, share, smoothing, strange, *not_measured)


@dataclass(frozen=True)
class InFlight:
    """The flights of a dataset, and how much of it they are.

    Attributes:
        dataset: the flights; the same dataset where nothing else is in it.
        mixed: number of tracks with something else than flight.
        held: in the tracks.
    """

    dataset: Dataset
    mixed: int
    held: Contents

    @property
    def lines(self) -> tuple[str, ...]:
        """Doubts, one sentence each."""
        said = list[str]()
        if self.mixed:
            rest = len(self.held.pieces) - self.mixed
            said.append(
                f"{int(100 * self.held.share)} % of the samples fall like a ball: {len(self.dataset) - rest} flights "
                f"of {self.mixed} tracks are used, {rest} tracks whole; the rest is held, rolls, rests or is lost"
            )
        return (*said, *self.filtered)

    @property
    def filtered(self) -> tuple[str, ...]:
        """Sentences on smoothed, repeated or filled positions and on other balls, unless `dataset.yaml` has them."""
        found = {SMOOTHING: smoothed(self.held.smoothing)} if self.held.smoothing > SMOOTHED else {}
        found |= {OTHER: self.held.others, REPEATED: self.held.repeated, FILLED: self.held.filled}
        known = " ".join(self.dataset.info.doubts)
        return tuple(said for sign, said in found.items() if said and sign not in known)

    def check(self, where: object, anyway: bool, say: str = ", or say --anyway") -> None:
        """Refuses a dataset that is mostly no flight. Args: say: how to use it anyway. Raises: ValueError."""
        if self.held.share < ENOUGH and not anyway:
            raise ValueError(
                f"{where} must show flights: only {100 * self.held.share:.0f} % of its samples fall like a ball. Cut "
                f"them out with ballfg import --flights, check units and axes{say}."
            )


def smoothed(ratio: float) -> str:
    """The sentence on positions that a filter smoothed. Args: ratio: of slow to fast errors."""
    return (
        f"{SMOOTHING} (errors that last are {ratio:.1f} times those from sample to sample): this "
        "is no free fall near bounces and throws, velocities lag, and sigmas are too small"
    )


def others(lost: float, jump: float) -> str:
    """The sentence on samples of other balls; empty without. Args: lost: their share.  jump: m, scatter of samples."""
    if jump > FARTHEST:
        return f"positions jump by {jump:.2g} m from sample to sample: they are {OTHER}"
    return f"{100 * lost:.0f} % of the samples lie off the ball's path: they are {OTHER}" if lost > OTHERS else ""


def unmeasured(share: float, least: float, what: str) -> str:
    """The sentence on positions in flight that are no measurements; empty up to a least share of them."""
    return f"{100 * share:.0f} % of the positions in flight {what}" if share > least else ""


def on_lines(track: Track) -> Mask:
    """(n,) True for samples that lie on the straight line through their neighbours, in time too, two or more in a row.

    A single one may: rounded positions meet it by chance.
    """
    velocities = np.diff(track.positions, axis=0) / np.diff(track.times)[:, None]
    spans = 0.5 * (track.times[2:] - track.times[:-2])
    even = np.zeros(len(track) + 2, dtype=bool)
    even[2:-2] = (np.abs(np.diff(velocities, axis=0)) < EVENLY * spans[:, None]).all(axis=1)
    return np.asarray(even[1:-1] & (even[:-2] | even[2:]))


@lru_cache(maxsize=16)
def in_flight(dataset: Dataset, most: int | None = None) -> InFlight:
    """The flights of a dataset.

    Args: dataset: of positions.  most: number of its first tracks that are looked at; None: all.
    """
    physics = physics_of(ready_nominal(dataset.ball))
    levels = (dataset.table + dataset.ball.radius, dataset.ball.radius)

    def whole(track: Track, labels: Labels) -> bool:
        return bool(labels.estimable(track.positions[:, 2], levels).all())

    tracks, copies = tee(islice(iter(dataset), most))
    count = len(dataset) if most is None else min(most, len(dataset))
    labels = map_tracks(partial(label_samples, physics=physics, levels=levels), copies, count, jobs_here())
    found = Contents.of(zip(tracks, labels, strict=True), whole)
    mixed = sum(pieces is not None for pieces in found.pieces.values())
    return InFlight(FlightsOf(dataset, found.pieces) if mixed else dataset, mixed, found)


def error_ratios(track: Track, labels: Labels) -> Array:
    """(w,) ratio of the residuals of cubics over `SPAN` to those through five neighbours, in the flights of a track."""
    found = list[float]()
    for first, last in labels.stretches(Label.FLIGHT):
        edges = [first, *(i + 1 for i in labels.bounces.tolist() if first <= i < last), last + 1]
        for begin, stop in pairwise(edges):
            found += _ratios(track.seconds[begin:stop], track.positions[begin:stop])
    return np.array(found)


def _ratios(times: Array, positions: Array) -> list[float]:
    """`error_ratios` of an arc."""
    if len(times) < LEAST_SPAN:
        return []
    size, found = max(LEAST_SPAN, round(SPAN / float(np.median(np.diff(times))))), list[float]()
    for begin in range(0, len(times) - size + 1, max(size // 2, 1)):
        t, p = times[begin : begin + size], positions[begin : begin + size]
        scaled = (t - t.mean()) / (t[-1] - t[0])
        basis, _ = np.linalg.qr(scaled[:, None] ** np.arange(4))
        slow = ((p - basis @ (basis.T @ p)) ** 2).sum() / (size - 4)
        neighbours = np.stack([p[i : size - 4 + i] for i in range(5)], axis=1)
        fast = (np.einsum("ni,nix->nx", contrasts(t), neighbours) ** 2).mean(axis=0).sum()
        found.append(float(np.sqrt((slow + ROUNDING**2) / (fast + ROUNDING**2))))
    return found


BEFORE: Final = {Label.HELD: "thrown", Label.ROLLING: "left a surface", Label.RESTING: "left a surface"}
"""Reasons of the beginning of a flight, by what was before."""
AFTER: Final = {Label.HELD: "caught", Label.ROLLING: "rolled", Label.RESTING: "came to rest"}
"""Reasons of its end, by what came after."""


@dataclass(frozen=True)
class Piece:
    """A flight in a track: first and last sample, inclusive, and why it begins and ends there."""

    first: int
    last: int
    begins: str
    ends: str

    def of(self, track: Track, name: str) -> Track:
        """The flight as a track, with the reasons among its labels."""
        reasons: dict[str, TrackLabel] = {"recording": track.name, "begins": self.begins, "ends": self.ends}
        part = track.between(float(track.times[self.first]), float(track.times[self.last]))
        return replace(part, name=name, labels={**part.labels, **reasons})


def pieces_of(labels: Labels) -> list[Piece]:
    """The flights of a labelled track."""
    values, found = labels.values, list[Piece]()
    for first, last in labels.stretches(Label.FLIGHT):
        before = Label(int(values[first - 1])) if first else None
        after = Label(int(values[last + 1])) if last + 1 < len(values) else None
        if last - first + 1 >= SHORTEST:
            begins = "start" if before is None else BEFORE.get(before, "seen again")
            found.append(Piece(first, last, begins, "end" if after is None else AFTER.get(after, "lost")))
    return found


def flights_of(track: Track, physics: SegmentationPhysics) -> list[Track]:
    """The flights of a track: itself, where nothing else is in it. Args: physics: of the ball."""
    labels = label_samples(track, physics)
    return [track] if flies_throughout(labels) else tracks_of(track, pieces_of(labels))


def names_of(track: str, pieces: Sequence[Piece]) -> list[str]:
    """The names of the flights in a track of a name."""
    return [f"{track}-{i:03d}" for i in range(len(pieces))]


def tracks_of(track: Track, pieces: Sequence[Piece]) -> list[Track]:
    """The flights in a track as tracks."""
    return [piece.of(track, name) for name, piece in zip(names_of(track.name, pieces), pieces, strict=True)]


def flies_throughout(labels: Labels) -> bool:
    """True if all samples of a track show a flight, apart from single lost ones."""
    return bool(np.isin(labels.values, (Label.FLIGHT, Label.LOST)).all() and (labels.values == Label.FLIGHT).any())
