"""Changes measured tracks as another instrument, tracker or air would have: each is one effect of a known strength."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.diagnosis.fit.effects import with_effects
from ballfg.diagnosis.fit.fit import fit_model
from ballfg.diagnosis.fit.holdout import hold_out
from ballfg.diagnosis.fit.stretches import joined
from ballfg.diagnosis.search.evaluation import fitted_model
from ballfg.dynamics import nominal_model, rollout
from ballfg.dynamics.effects.flight import Wind
from ballfg.dynamics.effects.measurement import FrameTilt, Scale, SpinLabelFrame, TimeScale
from ballfg.dynamics.measurement import MeasurementEffect
from ballfg.estimation.noise.tracker_errors import JITTER, MEMORY
from ballfg.state import POSITION, STATE_DIM
from ballfg.tracks import Dataset, Track
from ballfg.tracks.track import SPIN_LABELS

TILT: Final = 0.02  # rad, turn of the frame about its x axis
CLOCK: Final = 0.04  # Share by which durations are written too long
STRETCH: Final = 0.05
"""Share by which heights are written too large. Gravity shows it; along the flight it would resemble drag."""
STAMP_SIGMA: Final = 0.0025  # s, error of a stamp
MEMORY_SIGMA, MEMORY_TIME = 0.006, 0.02
"""m and s, of the tracker's lasting error: of each coordinate, and until its correlation is 1 / e."""
MOVED: Final = 0.012
"""m by which the rig sinks half-way, so that later balls are written higher. A horizontal move would not show: the
physics is the same everywhere above a table."""
LOST: Final = 5  # Of so many frames the last is lost
WIND_SPEED: Final = 0.6  # m/s, across the shots: along them a wind resembles drag
FIRST_PART: Final = 0.25  # s of a track that show which way it was shot
QUARTER_TURN: Final = {"xx": 0.0, "xy": 1.0, "yx": -1.0, "yy": 0.0}
"""Labels in a frame that is turned about the vertical: its x axis is the y axis of the positions."""


@dataclass(frozen=True)
class Changed:
    """Changed tracks, and the strength of the change: how far each coefficient of its effect is from absence."""

    tracks: Sequence[Track]
    strengths: Mapping[str, float]


Change = Callable[[Dataset, Sequence[Track], np.random.Generator], Changed]
"""From a dataset, its tracks to be changed in the order of the recording, and a generator."""


def read_by(effect: MeasurementEffect, track: Track) -> Track:
    """The track as an instrument with an effect would have written it."""
    states = torch.zeros((len(track), STATE_DIM), dtype=torch.float64)
    states[:, POSITION] = torch.from_numpy(track.positions)
    label, labels = track.spin_label, dict(track.labels)
    with torch.no_grad():
        positions = effect.positions(states, lambda delay: states).numpy()
        times = track.times[0] + effect.stamps(torch.from_numpy(track.times - track.times[0])).numpy()
        if label is not None:
            labels |= dict(zip(SPIN_LABELS, effect.label(torch.from_numpy(label)).tolist(), strict=True))
    return replace(track, times=times, positions=positions, labels=labels)


def _instrument(effect: MeasurementEffect) -> Change:
    absent = {c.name: c.absent for c in effect.coefficients if c.absent is not None}
    strengths = {name: value - absent[name] for name, value in effect.values().items() if name in absent}

    def change(dataset: Dataset, tracks: Sequence[Track], rng: np.random.Generator) -> Changed:
        return Changed([read_by(effect, track) for track in tracks], strengths)

    return change


def with_jitter(dataset: Dataset, tracks: Sequence[Track], rng: np.random.Generator) -> Changed:
    """Each sample keeps its position and gets a stamp that errs; where two stamps change places, a reader sorts."""

    def jittered(track: Track) -> Track:
        times = track.times + STAMP_SIGMA * rng.standard_normal(len(track))
        order = np.argsort(times)
        sigmas = None if track.sigmas is None else track.sigmas[order]
        return replace(track, times=times[order], positions=track.positions[order], sigmas=sigmas)

    return Changed([jittered(track) for track in tracks], {"sigma": STAMP_SIGMA})


def with_memory(dataset: Dataset, tracks: Sequence[Track], rng: np.random.Generator) -> Changed:
    """Each coordinate gets an error whose correlation decays exponentially with the time between samples."""

    def remembered(track: Track) -> Track:
        errors = MEMORY_SIGMA * rng.standard_normal((len(track), 3))
        kept = np.exp(-np.diff(track.times) / MEMORY_TIME)
        for k, share in enumerate(kept, start=1):
            errors[k] = share * errors[k - 1] + np.sqrt(1.0 - share**2) * errors[k]
        return replace(track, positions=track.positions + errors)

    return Changed([remembered(track) for track in tracks], {"sigma": MEMORY_SIGMA})


def with_rig_moved(dataset: Dataset, tracks: Sequence[Track], rng: np.random.Generator) -> Changed:
    """The later half of the tracks is written higher."""
    up = np.array([0.0, 0.0, MOVED])
    half = len(tracks) // 2
    moved = [replace(track, positions=track.positions + up) for track in tracks[half:]]
    return Changed([*tracks[:half], *moved], {"offset": MOVED})


def with_frames_lost(dataset: Dataset, tracks: Sequence[Track], rng: np.random.Generator) -> Changed:
    """Every fifth frame is lost, and stamps count the others at the set's median interval.

    Frames that the recording had lost before are counted through with them; they are part of the strength.
    """
    period = float(np.median(np.concatenate([np.diff(track.times) for track in tracks])))
    counted, true = [], []
    for track in tracks:
        kept = np.flatnonzero(np.arange(len(track)) % LOST != LOST - 1)
        sigmas = None if track.sigmas is None else track.sigmas[kept]
        times = track.times[0] + period * np.arange(len(kept))
        counted.append(replace(track, times=times, positions=track.positions[kept], sigmas=sigmas))
        true.append(track.times[kept[-1]] - track.times[0])
    missing = sum(true) / sum(track.duration for track in counted) - 1.0
    return Changed(counted, {"missing": float(missing)})


def with_wind(dataset: Dataset, tracks: Sequence[Track], rng: np.random.Generator) -> Changed:
    """The first flight of each track, up to a hit, moved by what a wind across the shots does to it.

    Two balls start as a fit of the whole set estimates for the track, one in the wind. The difference of their paths,
    through all bounces at their own moments, is added to the measured positions.
    """
    model = nominal_model(dataset.info.ball.radius)
    holdout = hold_out(dataset, model)
    later = replace(holdout.held_out, track=holdout.held_out.track + len(holdout.tracks))
    fit = fit_model(model, joined([holdout.search, later]), holdout.settings, tracks=holdout.tracks)
    x, y = WIND_SPEED * across(tracks)
    calm = fitted_model(fit)
    windy = with_effects(calm, Wind(x=float(x), y=float(y)))
    parts = {part.track.name: part.track for part in (*holdout.search_tracks, *holdout.held_out_tracks)}
    stretches, moved = fit.problem.stretches, dict[str, Track]()
    for row, name in enumerate(stretches.names):
        count, part = int(stretches.used[row].sum()), parts.get(name)
        if part is None or not np.array_equal(part.positions[0], stretches.positions[row, 0].numpy()):
            continue  # not the first flight of its track
        start = torch.from_numpy(fit.unknowns.starts[row : row + 1])
        times = torch.from_numpy(part.times[:count] - part.times[0])
        with torch.no_grad():
            paths = [rollout(one, start, times, holdout.surfaces)[0, :, POSITION].numpy() for one in (calm, windy)]
        cut = part.until(float(part.times[count - 1]))
        moved[name] = replace(cut, positions=cut.positions + paths[1] - paths[0])
    return Changed([moved[t.name] for t in tracks if t.name in moved], {"x": float(x), "y": float(y), "z": 0.0})


def across(tracks: Sequence[Track]) -> Array:
    """(2,) the horizontal unit vector across the shots: along it they get least far at first."""
    first = [track.opening(FIRST_PART).positions[:, :2] for track in tracks]
    ways = np.array([places[-1] - places[0] for places in first])
    side = np.linalg.eigh(ways.T @ ways)[1][:, 0]
    return np.asarray(side * np.sign(side[np.argmax(np.abs(side))]))


CHANGES: Final[dict[str, Change]] = {
    FrameTilt.name: _instrument(FrameTilt(x=TILT)),
    TimeScale.name: _instrument(TimeScale(s=CLOCK)),
    Scale.name: _instrument(Scale(z=STRETCH)),
    JITTER: with_jitter,
    MEMORY: with_memory,
    "table_height_drift": with_rig_moved,
    SpinLabelFrame.name: _instrument(SpinLabelFrame(**QUARTER_TURN)),
    "counted_frames": with_frames_lost,
    Wind.name: with_wind,
}
"""By the name that a diagnosis should give."""


def applicable(dataset: Dataset) -> Iterator[str]:
    """The changes that a dataset can have: labels can only be turned where there are some."""
    labelled = set(SPIN_LABELS) <= set(dataset.label_names)
    return (name for name in CHANGES if labelled or name != SpinLabelFrame.name)
