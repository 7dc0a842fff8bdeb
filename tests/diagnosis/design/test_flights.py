"""The launcher learned from shots, and flights planned with it, against the simulation's own launcher and motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ballfg.diagnosis.design.information import View, planned_flights
from ballfg.diagnosis.design.plan import learn_launcher
from ballfg.simulation import MeasurementNoise, SimulationConfig, simulate, table_tennis
from ballfg.simulation.settings import all_settings

NAMES = ("topspin", "sidespin", "speed")
STEADY = {"position_spread": 0.0, "speed_spread": 0.0, "aim_spread": 0.0, "spin_spread": 0.0}


def test_the_simulated_launcher_is_learned_exactly() -> None:
    """Its speed, elevation and spin are lines in the settings; twelve shots tell all others."""
    launcher, settings = table_tennis().launcher.with_fields(STEADY), all_settings()
    states = launcher.launch(settings, 0.76, np.random.default_rng(0)).numpy()
    some = np.random.default_rng(1).integers(len(settings), size=12)
    learned = learn_launcher(NAMES, settings[some].astype(float), states[some])
    # axes of a launch fade out towards the vertical: 1.24 rad up is 1.1 m/s forward
    np.testing.assert_allclose(learned.states(settings.astype(float)), states, atol=0.6)
    np.testing.assert_allclose(learned.states(settings.astype(float))[:, :6], states[:, :6], atol=1e-9)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (np.ones((4, 2)), "at least 5 shots"),
        (np.column_stack((np.arange(9.0), np.ones(9))), "label b must change"),
        (np.column_stack((np.arange(9.0), 2 * np.arange(9.0))), "independently"),
    ],
)
def test_shots_that_do_not_tell_what_settings_do(settings: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        learn_launcher(("a", "b"), settings, np.ones((len(settings), 9)))


def test_planned_flights_are_those_that_are_shot() -> None:
    kind = table_tennis()
    kind = replace(kind, launcher=kind.launcher.with_fields(STEADY))
    config = SimulationConfig(40, ball=kind, seed=4, noise=MeasurementNoise(position=0.0))
    simulated = list(simulate(config))
    starts = np.stack([s.true_states[0] for s in simulated])
    view = View(
        np.array((-0.4, -1.2, 0.76)), np.array((3.2, 1.2, np.inf)), 1.32, 0.01, np.full(3, 0.003), labelled=True
    )
    flights, kept = planned_flights(kind.model, starts, np.zeros((40, 0)), kind.surfaces, view)
    assert kept.all()
    for number, shot in enumerate(simulated):
        used = flights.used[number]
        positions = flights.positions[number][used].numpy()
        both = min(len(positions), len(shot.true_states))
        assert both > 0.9 * len(shot.true_states) or flights.contacts[number].isfinite().all()
        np.testing.assert_allclose(positions[:both], shot.true_states[:both, :3], atol=1e-5)
        bounces = (np.diff(shot.true_states[:both, 5]) > 0.5).sum()
        assert int(flights.contacts[number].isfinite().sum()) == bounces
    assert isinstance(flights.times, torch.Tensor)
