"""Synthetic balls whose events are known."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
import torch

from ballfg.dynamics import BallModel, Surfaces, nominal_model, rollout

TABLE = 0.75
SIGMA = 0.0015


@dataclass
class Truth:
    """True states (n, 9) at stamps (n,), and the intervals in which something happened."""

    times: np.ndarray
    states: np.ndarray
    contacts: list[int]
    hits: list[int]

    def measured(self, rng: np.random.Generator, sigma: float = SIGMA) -> np.ndarray:
        return self.states[:, :3] + rng.normal(0, sigma, (len(self.times), 3))


def fly(
    model: BallModel,
    start: Sequence[float],
    times: np.ndarray,
    surfaces: Surfaces,
    hits: dict[int, Sequence[float]] | None = None,
) -> Truth:
    """A ball from a state (9,) on; at the stamps in `hits` its velocity becomes another."""
    hits = hits or {}
    path = np.tile(np.array(start, dtype=np.float64), (len(times), 1))
    after = path.copy()  # what each stamp goes on from: the state there, with another velocity where it is hit
    for begin, end in pairwise([0, *sorted(set(hits) - {0, len(times) - 1}), len(times) - 1]):
        after[begin] = path[begin]
        after[begin, 3:6] = hits.get(begin, after[begin, 3:6])
        stamps = torch.from_numpy(times[begin + 1 : end + 1] - times[begin])
        with torch.no_grad():
            flown = rollout(model, torch.from_numpy(after[None, begin]), stamps, surfaces)
        path[begin + 1 : end + 1] = after[begin + 1 : end + 1] = flown[0].numpy()
    contacts = np.flatnonzero(path[1:, 5] > after[:-1, 5] + 0.05).tolist()
    return Truth(times, path, contacts, sorted(hits))


def rally(seed: int, rate: float = 180.0, duration: float = 2.0, hits: int = 1) -> Truth:
    """A spinning ball over an endless table, hit back in the air; the stamps jitter by 0.1 ms."""
    rng = np.random.default_rng(seed)
    times = np.arange(0, duration, 1 / rate)
    times = times + rng.uniform(0, 2e-4, len(times))
    surfaces = Surfaces(TABLE)
    start = [0, 0, 1.15, rng.uniform(-1, 1), rng.uniform(3, 6), rng.uniform(0, 2), *rng.normal(0, 100, 3)]
    blows: dict[int, Sequence[float]] = {}
    for k in range(hits):
        low = int((0.25 + k * (duration - 0.3) / hits) * rate)
        high = int((k + 1) * (duration - 0.3) / hits * rate)
        free = fly(nominal_model(), start, times, surfaces, blows)
        window = free.states[low:high, 2]
        i = low + int(rng.choice(np.flatnonzero(window >= np.median(window))))
        sign = -np.sign(free.states[i, 4])
        blows[i] = [rng.uniform(-2, 2), sign * rng.uniform(2, 6), rng.uniform(0.5, 3)]
    return fly(nominal_model(), start, times, surfaces, blows)


def matched(found: Sequence[int], true: Sequence[int], tolerance: int = 1) -> tuple[int, int]:
    """How many of the true intervals were not found, and how many of the found ones are not true."""
    missed = sum(not any(abs(f - t) <= tolerance for f in found) for t in true)
    false = sum(not any(abs(f - t) <= tolerance for t in true) for f in found)
    return missed, false


@pytest.fixture(scope="session")
def rallies() -> list[Truth]:
    return [rally(seed) for seed in range(10)]


@pytest.fixture(scope="session")
def make_rally() -> Callable[..., Truth]:
    return rally


@pytest.fixture(scope="session")
def make_flight() -> Callable[..., Truth]:
    return fly


@pytest.fixture(scope="session")
def match() -> Callable[..., tuple[int, int]]:
    return matched
