"""Stretches of simulated shots without a file or a smoother, from `paths`; one fit that several tests look at."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from torch import Tensor

from ballfg.diagnosis.fit.fit import first_guess, fit_model, fit_problem
from ballfg.diagnosis.fit.problem import Fit, Problem
from ballfg.diagnosis.fit.stretches import Stretches
from ballfg.dynamics import EFFECTS, AnalyticModel, Surfaces
from ballfg.dynamics.effect import Effect
from ballfg.dynamics.effects.bounce import Restitution
from ballfg.dynamics.effects.flight import Drag, Gravity, Magnus
from ballfg.dynamics.motion.paths import paths
from ballfg.estimation.settings import Settings

TABLE = 0.76
SURFACES = Surfaces(TABLE)
POSITION_NOISE, LABEL_NOISE = 0.003, 4.0
FINE = 1e-3
"""s, spacing at which contacts are looked for."""


def ball(**effects: dict[str, float]) -> AnalyticModel:
    """Gravity, drag, Magnus, restitution and friction, and the effects named; nothing of it learns."""
    base: dict[str, dict[str, float]] = {"gravity": {}, "drag": {}, "magnus": {}, "restitution": {}, "friction": {}}
    return AnalyticModel([EFFECTS[name](**values) for name, values in (base | effects).items()]).requires_grad_(False)


def launches(count: int, seed: int, *, spread: float = 0.5, spin: float = 60.0) -> Tensor:
    """(n, 9) shots 0.3 m above the table at 3.5 to 5 m/s, in directions `spread` rad about +x."""
    rng = np.random.default_rng(seed)
    angle, speed = spread * rng.standard_normal(count), rng.uniform(3.5, 5.0, count)
    states = np.zeros((count, 9))
    states[:, :3] = (0.0, 0.0, TABLE + 0.3) + 0.05 * rng.standard_normal((count, 3))
    states[:, 3], states[:, 4] = speed * np.cos(angle), speed * np.sin(angle)
    states[:, 5] = rng.uniform(0.0, 1.5, count)
    states[:, 6:] = spin * rng.standard_normal((count, 3))
    return torch.from_numpy(states)


def turned(vectors: Tensor, angle: float) -> Tensor:
    """Vectors (..., 3 m) turned about z."""
    c, s = math.cos(angle), math.sin(angle)
    matrix = torch.tensor(((c, -s, 0), (s, c, 0), (0, 0, 1)), dtype=torch.float64)
    return (vectors.unflatten(-1, (-1, 3)) @ matrix.T).flatten(-2)


@torch.no_grad()
def contacts_of(model: AnalyticModel, states: Tensor, duration: float) -> Tensor:
    """(n, c) s, to `FINE`, when balls bounce; NaN where there is no further contact."""
    grid = torch.arange(0.0, duration, FINE, dtype=torch.float64)
    rise = paths(model, states, grid, SURFACES)[..., 5]
    jumps = (rise[:, :-1] < 0) & (rise[:, 1:] > 0)
    found = [grid[:-1][row] + FINE / 2 for row in jumps]
    times = torch.full((len(states), max(len(f) for f in found)), torch.nan, dtype=torch.float64)
    for row, own in zip(times, found, strict=True):
        row[: len(own)] = own
    return times


@dataclass(frozen=True)
class Shots:
    """Simulated stretches and the true states at their first samples."""

    stretches: Stretches
    states: Tensor


@torch.no_grad()
def shots(
    model: AnalyticModel,
    states: Tensor,
    seed: int = 0,
    *,
    duration: float = 0.7,
    rate: float = 60.0,
    noise: float = POSITION_NOISE,
    label: float = LABEL_NOISE,
    labelled: bool = True,
) -> Shots:
    """Stretches of balls as a model moves and measures them, with noise of the given size beside the stated one."""
    rng, n = np.random.default_rng(1000 + seed), len(states)
    times = torch.arange(round(duration * rate), dtype=torch.float64) / rate

    def at(delay: Tensor | float) -> Tensor:
        shift = delay if isinstance(delay, float) else delay.reshape(-1, 1)
        return paths(model, states, (times + shift).expand(n, -1), SURFACES)

    positions = model.measured(at(0.0), at) + noise * torch.from_numpy(rng.standard_normal((n, len(times), 3)))
    labels = model.labelled(states[:, 6:]) + label * torch.from_numpy(rng.standard_normal((n, 3)))
    guess = torch.tensor([2e-3] * 3 + [2e-2] * 3 + [5.0] * 3, dtype=torch.float64)
    contacts = contacts_of(model, states, float(times[-1]))
    made = Stretches(
        names=tuple(f"{i:03d}" for i in range(n)),
        track=np.arange(n),
        settings=np.zeros((n, 1)) if labelled else np.ones((n, 1)),
        times=model.stamps(times).expand(n, -1).clone(),
        positions=positions,
        sigmas=torch.full_like(positions, POSITION_NOISE),
        starts=states + guess * torch.from_numpy(rng.standard_normal((n, 9))),
        heights=torch.full_like(contacts, TABLE).masked_fill(contacts.isnan(), torch.nan),
        contacts=contacts,
        labels=labels if labelled else torch.full_like(labels, torch.nan),
    )
    return Shots(made, states)


def fitted(model: AnalyticModel, stretches: Stretches, *, settle_noise: bool = True) -> Fit:
    """The joint fit of a declared model."""
    return fit_model(model, stretches, Settings(spin_label_noise=LABEL_NOISE), settle_noise=settle_noise)


def known_ball(*effects: Effect) -> AnalyticModel:
    """A ball without friction that nothing is free of, and further effects."""
    return AnalyticModel([Gravity(), Drag(), Magnus(), Restitution(), *effects]).requires_grad_(False)


def fitted_to_known(stretches: Stretches, *effects: Effect) -> Fit:
    """The fit of first states alone, with `known_ball`."""
    unknowns, noise = first_guess(problem := Problem(known_ball(*effects), stretches, {}), LABEL_NOISE, 60.0)
    return fit_problem(problem, unknowns, noise, settle_noise=False)


@pytest.fixture
def blank_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of a page have their captions and are left blank: to draw them takes seconds."""
    monkeypatch.setattr(Figure, "savefig", lambda *file, **options: None)


@pytest.fixture(scope="session")
def make_known_ball() -> Callable[..., AnalyticModel]:
    return known_ball


@pytest.fixture(scope="session")
def make_ball() -> Callable[..., AnalyticModel]:
    return ball


@pytest.fixture(scope="session")
def make_launches() -> Callable[..., Tensor]:
    return launches


@pytest.fixture(scope="session")
def make_shots() -> Callable[..., Shots]:
    return shots


@pytest.fixture(scope="session")
def make_fit() -> Callable[..., Fit]:
    return fitted


@pytest.fixture(scope="session")
def make_known_fit() -> Callable[..., Fit]:
    return fitted_to_known


@pytest.fixture(scope="session")
def turn() -> Callable[[Tensor, float], Tensor]:
    return turned


@pytest.fixture(scope="session")
def surfaces() -> Surfaces:
    return SURFACES


WIND = (0.5, -0.3, 0.0)
"""m/s, along and across the shots."""


@pytest.fixture(scope="session")
def windy() -> Shots:
    """Sixteen shots in a wind that no model declares."""
    return shots(ball(wind=dict(zip("xyz", WIND, strict=True))), launches(16, 1), 1)


@pytest.fixture(scope="session")
def windy_fit(windy: Shots) -> Fit:
    """The declared model, without wind, fitted to `windy`."""
    return fitted(ball(), windy.stretches)


@pytest.fixture(scope="session")
def calm_fit() -> Fit:
    """The declared model fitted to sixteen shots of its own."""
    return fitted(ball(), shots(ball(), launches(16, 2), 2).stretches)
