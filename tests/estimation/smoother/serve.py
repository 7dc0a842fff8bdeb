"""A serve over a table, as measured with 1.5 mm of noise, and what an honest estimate of it is.

Truth is a rollout of the model the smoother uses, without process noise. "Honest" is: a status that says how it went,
finite numbers, and the truth within 4 standard deviations in every component.
"""

from __future__ import annotations

import numpy as np
import torch

from ballfg.dynamics import Surfaces, nominal_model, rollout
from ballfg.estimation.result import Estimate
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.tracks import Track

SIGMA = 0.0015


MODEL = nominal_model()


TABLE = Surfaces.table_tennis(0.0)


SERVE = [0.0, 0.0, 0.3, 4.0, 0.3, 1.0, 10.0, 60.0, 20.0]


TIMES = 0.01 * np.arange(80)


EXACT = Settings(position_noise=(SIGMA,) * 3)


UNCERTAIN = Settings.for_measured(MODEL, position_noise=(SIGMA,) * 3)


def truth(start: list[float], times: np.ndarray = TIMES, surfaces: Surfaces = TABLE) -> np.ndarray:
    """(n, 9) states of the undisturbed ball."""
    with torch.no_grad():
        state = torch.tensor([start], dtype=torch.float64)
        return rollout(MODEL, state, torch.from_numpy(times - times[0]), surfaces)[0].numpy()


LATER = TIMES + 0.005
"""s, stamps between which the serve bounces half way: at 0.3498 s."""


def truth_at(times: np.ndarray) -> np.ndarray:
    """The serve at times of its own clock."""
    return truth(SERVE, np.concatenate(([0.0], times)))[1:]


def measured(states: np.ndarray, seed: int = 1) -> np.ndarray:
    return states[:, :3] + SIGMA * np.random.default_rng(seed).standard_normal((len(states), 3))


def bounces(states: np.ndarray) -> list[int]:
    """Intervals in which the ball turned upwards."""
    return np.flatnonzero(np.diff(states[:, 5]) > 0.5).tolist()


def intervals(estimate: Estimate) -> list[int]:
    return [contact.interval for contact in estimate.contacts]


def honest(estimate: Estimate, states: np.ndarray, *, sigmas: float = 4.0) -> None:
    assert np.isfinite(estimate.states).all()
    sigma = estimate.sigmas
    assert np.isfinite(sigma).all()
    assert (sigma > 0).all()
    correlation = estimate.covariances / (sigma[:, :, None] * sigma[:, None, :])
    assert np.linalg.eigvalsh(correlation).min() > 0
    assert np.abs((estimate.states - states) / sigma).max() < sigmas


def estimate_of(states: np.ndarray, positions: np.ndarray, settings: Settings, times=TIMES, surfaces=TABLE) -> Estimate:
    return Smoother(MODEL, surfaces, settings).estimate(Track(times, positions, name="t"))
