"""What settings tell of the spin must not be lost on the way from a rough start; wrong ones must still be set aside."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.diagnosis.fit.effects import with_effects
from ballfg.dynamics import nominal_model
from ballfg.dynamics.effects.flight import DragSpin
from ballfg.estimation.launcher import Launcher
from ballfg.estimation.result import Estimate, Status
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.noise import ProcessNoise
from ballfg.simulation import SimulationConfig, simulate
from ballfg.simulation.balls import with_model
from ballfg.state import SPIN
from ballfg.tracks import Track

SPREAD = 3.3
"""rad/s, of the spins that a setting gives."""
MODEL = with_effects(nominal_model(), DragSpin())
"""Drag that depends on |spin|: along the flight only through it, so that a spin may run far there for a small gain."""
KIND = with_model(SimulationConfig().ball, MODEL)
SETTINGS = Settings(
    position_noise=(0.003,) * 3,
    process=ProcessNoise(0.003, 0.03, 0.0006, 0.006, 0.3, 10.0, 100.0),
    launcher=Launcher.of_levels(KIND.launcher.topspin_scale, KIND.launcher.sidespin_scale, SPREAD),
)


@pytest.fixture(scope="module")
def starts() -> list[tuple[Track, np.ndarray]]:
    """The first 0.3 s of tracks, of which the launcher's settings are known, and their true spins."""
    config = SimulationConfig(tracks=40, rate=120.0, seed=7, ball=KIND, spin_labels=False)
    made = list(simulate(config))[20:30]
    return [(s.track.between(s.track.times[0], s.track.times[0] + 0.3), s.true_states[0, SPIN]) for s in made]


def estimated(track: Track) -> Estimate:
    return Smoother(MODEL, KIND.surfaces, SETTINGS).estimate(track)


def test_settings_that_are_right_hold(starts) -> None:
    for track, spin in starts:
        estimate = estimated(track)
        assert estimate.status is Status.OK
        assert np.abs(estimate.states[0, SPIN] - spin).max() < 5.0 * SPREAD


def test_settings_that_contradict_the_flight_are_set_aside(starts) -> None:
    told = 4.0 * KIND.launcher.sidespin_scale
    for track, spin in (starts[1], starts[4], starts[5]):  # flights that show sidespin to some 17 rad/s by themselves
        wrong = replace(track, labels={**track.labels, "sidespin": track.labels["sidespin"] + 4.0})
        estimate = estimated(wrong)
        error = abs(estimate.states[0, 8] - spin[2])
        assert error < 4.0 * estimate.sigmas[0, 8] < 0.5 * told
