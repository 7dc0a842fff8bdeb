"""Do the error bars of the noise hold: simulated sets whose every number is known, and how far off each is found.

    python -m tests.estimation.noise.intervals --sets 14 --seed 2

draws so many worlds - tracker, flights, bounces, labels, coefficients - and prints z = log(found / true) / log(factor)
of every number, the same by the side of its interval on which the truth lies, where that side is closed, and of numbers
that are zero, such as a memory that is not there, whether a lower limit is stated all the same. `--world usual` is the
world of `Settings.for_measured`, `--world lasting` the same with 0.5 mm of white noise beside 2 mm that last for 10 ms.
"""

from __future__ import annotations

import argparse
import copy
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.dynamics import AnalyticModel
from ballfg.estimation import Settings, estimate_noise
from ballfg.estimation.measurement.position_noise import estimate_position_noise
from ballfg.estimation.noise.estimate import NoiseEstimate
from ballfg.simulation import MotionNoise, table_tennis
from ballfg.simulation.launcher import SimulatedLauncher
from ballfg.simulation.motion import KickedModel, simulate_motion
from ballfg.state import POSITION, VELOCITY
from ballfg.tracks import Track
from ballfg.tracks.track import SPIN_LABELS

KIND = table_tennis()
LAUNCHER = SimulatedLauncher(x_low=-90.0, x_high=90.0, y_far=90.0, duration=0.8)
STARTS = np.array([[0.2, -0.3, 0.95, 2.5, -0.8, -2.0], [0.6, 0.3, 1.25, 5.5, 0.8, 1.5]])
"""Lowest and highest place (m) and velocity (m/s) at the start: balls that bounce once or twice in 0.8 s."""
SPINS = 60.0
"""rad/s, standard deviation per axis of labelled spins."""


@dataclass(frozen=True)
class World:
    """True numbers of a set; names and units are those of `TrackNoise`, `coefficients` is the multiple of the usual.

    Attributes: values: by name, with the axis where there are three.  labelled: spins.  rate: Hz.  tracks: how many.
    """

    values: dict[str, float]
    labelled: bool
    rate: float
    tracks: int


def drawn(rng: np.random.Generator) -> World:
    """A world: most trackers have no memory or no jitter."""

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    lasting, jittery, labelled = rng.random(3) < (0.5, 0.3, 0.6)
    white, memory = between(5e-4, 3e-3), between(1e-3, 3e-3) if lasting else 0.0
    values = {f"position.{a}": white * between(0.8, 1.25) for a in "xyz"}
    values |= {f"memory.{a}": memory * between(0.8, 1.25) for a in "xyz"}
    values |= {
        "memory_time": between(0.008, 0.03) if lasting else 0.0,
        "stamp_jitter": between(2e-4, 6e-4) if jittery else 0.0,
        "acceleration": between(0.05, 0.4),
        "contact_velocity": between(0.01, 0.05),
        "contact_tangential": between(0.08, 0.3),
        "contact_spin": between(5.0, 20.0),
        "coefficients": between(0.6, 1.6),
        "spin_label" if labelled else "spin_prior": between(3.0, 12.0) if labelled else between(30.0, 100.0),
    }
    return World(values, bool(labelled), float(rng.choice([80.0, 120.0, 200.0])), int(rng.integers(14, 21)))


def usual(_: np.random.Generator, white: float = 0.002, memory: float = 0.0) -> World:
    """The world of `Settings.for_measured` with labels right to 4 rad/s.

    Args: white, memory: m; a memory lasts for 10 ms.
    """
    values = {f"position.{a}": white for a in "xyz"} | {f"memory.{a}": memory for a in "xyz"}
    values |= {"acceleration": 0.1, "coefficients": 1.0, "spin_label": 4.0}
    values |= {"memory_time": 0.01 if memory else 0.0, "stamp_jitter": 0.0}
    values |= {"contact_velocity": 0.02, "contact_tangential": 0.2, "contact_spin": 10.0}
    return World(values, True, 120.0, 20)


WORLDS: dict[str, Callable[[np.random.Generator], World]] = {
    "drawn": drawn,
    "usual": usual,
    "lasting": partial(usual, white=5e-4, memory=2e-3),
}


class Scattered(KickedModel):
    """A model whose bounces scatter more along the surface than across it."""

    def __init__(self, model: AnalyticModel, values: dict[str, float], rng: np.random.Generator) -> None:
        across = values["contact_velocity"]
        super().__init__(model, MotionNoise(contact_velocity=across, contact_spin=values["contact_spin"]), rng)
        self._sigma[VELOCITY.start : VELOCITY.start + 2] = float(np.hypot(across, values["contact_tangential"]))


def tracks_of(world: World, rng: np.random.Generator) -> list[Track]:
    """The tracks of a world as its tracker measures them."""
    found, values = [], world.values
    spreads = Settings.for_measured(KIND.model).coefficients
    for number in range(world.tracks):
        model = with_own_coefficients(KIND.model, {n: values["coefficients"] * s for n, s in spreads.items()}, rng)
        spin = (SPINS if world.labelled else values["spin_prior"]) * rng.standard_normal(3)
        start = torch.from_numpy(np.concatenate((rng.uniform(*STARTS), spin)))[None]
        moving = Scattered(model, values, rng)
        process = MotionNoise(acceleration=values["acceleration"], spin=1.0)
        motion = simulate_motion(moving, start, world.rate, KIND.surfaces, LAUNCHER, process, rng)
        states = motion.states[0, : motion.lengths[0]]
        labels = {}
        if world.labelled:
            labels = dict(zip(SPIN_LABELS, spin + values["spin_label"] * rng.standard_normal(3), strict=True))
        found.append(measured(states, world, labels, f"{number:03d}", rng))
    return found


def with_own_coefficients(model: AnalyticModel, sigmas: dict[str, float], rng: np.random.Generator) -> AnalyticModel:
    """A copy of a model with coefficients of its own."""
    own = copy.deepcopy(model)
    with torch.no_grad():
        for name, parameter in own.named_parameters():
            if name in sigmas:
                parameter += sigmas[name] * rng.standard_normal()
    return own


def measured(states: Array, world: World, labels: dict[str, float], name: str, rng: np.random.Generator) -> Track:
    """A track with white errors, errors that last and errors of stamps."""
    values, n = world.values, len(states)
    times = np.arange(n) / world.rate
    white = np.array([values[f"position.{a}"] for a in "xyz"]) * rng.standard_normal((n, 3))
    lasting, memory = rng.standard_normal((n, 3)), np.array([values[f"memory.{a}"] for a in "xyz"])
    kept = np.exp(-1.0 / (world.rate * values["memory_time"])) if values["memory_time"] else 0.0
    for k in range(1, n):
        lasting[k] = kept * lasting[k - 1] + np.sqrt(1.0 - kept**2) * lasting[k]
    late = values["stamp_jitter"] * rng.standard_normal((n, 1)) * states[:, VELOCITY]
    return Track(times, states[:, POSITION] + white + memory * lasting + late, labels=labels, name=name)


def found_in(tracks: list[Track]) -> NoiseEstimate:
    """The noise of tracks, begun as a dataset begins that states none."""
    white = estimate_position_noise(tracks)
    settings = Settings.for_measured(KIND.model, position_noise=tuple(white.tolist()))
    estimate = estimate_noise(KIND.model, KIND.surfaces, settings, tracks)
    assert estimate is not None
    return estimate


def value_of(estimate: NoiseEstimate, name: str) -> float:
    """The number of a name with its axis, in its own unit."""
    field, _, axis = name.partition(".")
    if field == "coefficients":
        return estimate.coefficient_factors[axis]
    value = getattr(estimate.noise, field)
    return float(value["xyz".index(axis)] if axis else value)


@dataclass(frozen=True)
class Row:
    """One number of one set: true and found, its factor's logarithm, and its interval."""

    name: str
    true: float
    found: float
    error: float
    low: float
    high: float

    @property
    def z(self) -> float:
        """Of the factor, to be standard normal at most: it is that of the longer side."""
        return float(np.log(self.found / self.true) / self.error)

    @property
    def closed(self) -> bool:
        """Whether the interval ends on the side of the truth; else the tracks are said not to tell."""
        return bool(self.low > 0.0 if self.true < self.found else np.isfinite(self.high))

    @property
    def side_z(self) -> float:
        """Of the side of the interval on which the truth is."""
        limit = self.low if self.true < self.found else self.high
        return float(np.log(self.found / self.true) / abs(np.log(self.found / limit)))


def rows_of(world: World, estimate: NoiseEstimate) -> Iterator[Row]:
    """All numbers of a set that its world has: a label is none of a part of a track that begins after a hit."""
    for name, error in estimate.relative_errors.items():
        planted = "coefficients" if name.startswith("coefficients.") else name
        if planted in world.values:
            yield Row(name, world.values[planted], value_of(estimate, name), error, *estimate.intervals[name])


def worlds(
    count: int, seed: int, draw: Callable[[np.random.Generator], World] = drawn
) -> Iterator[tuple[World, list[Track]]]:
    """So many worlds and their tracks."""
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        world = draw(rng)
        yield world, tracks_of(world, rng)


def rms(values: Iterable[float]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(list(values)))))


def summary(rows: Sequence[Row]) -> Iterator[str]:
    """Lines on numbers by name, and on all of them."""
    groups = defaultdict(list)
    for row in rows:
        groups[row.name.partition(".")[0]].append(row)
    for name, group in [*groups.items(), ("all", list(rows))]:
        true = [row for row in group if row.true > 0.0]
        closed = [row for row in true if row.closed]
        there = f"{len(true):4} z rms {rms(r.z for r in true):5.2f}" if true else f"{0:4}" + 12 * " "
        sides = f"{len(closed):4} with that side closed, rms {rms(r.side_z for r in closed):5.2f}" if closed else ""
        none = [row for row in group if row.true == 0.0]
        said = f"; of {len(none)} that are zero {sum(r.low == 0.0 for r in none)} have no lower limit" if none else ""
        yield f"{name:20} {there} {sides}{said}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=14)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--world", choices=list(WORLDS), default="drawn")
    given = parser.parse_args()
    rows: list[Row] = []
    for number, (world, tracks) in enumerate(worlds(given.sets, given.seed, WORLDS[given.world])):
        estimate = found_in(tracks)
        print(f"set {number}: {world.tracks} tracks at {world.rate:g} Hz")
        for row in rows_of(world, estimate):
            factor, limits = np.exp(row.error), f"{row.low:9.3g} to {row.high:9.3g}"
            z = f"z {row.z:5.2f}" if row.true else ""
            print(f"  {row.name:20} true {row.true:9.3g} found {row.found:9.3g} x/: {factor:5.2f} {limits} {z}")
            rows.append(row)
    print("\n".join(summary(rows)), flush=True)


if __name__ == "__main__":
    main()
