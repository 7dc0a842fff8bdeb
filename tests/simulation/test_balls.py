"""Other balls than the default one: files, and a flight of each, estimated with right errors and covariances."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from ballfg.dynamics import AnalyticModel, nominal_model
from ballfg.dynamics.known_balls import KNOWN_BALLS
from ballfg.estimation import Settings, Smoother, Status
from ballfg.factors.loss import Loss
from ballfg.factors.noise import ProcessNoise
from ballfg.simulation import MeasurementNoise, MotionNoise, SimulationConfig, simulate, tennis
from ballfg.simulation.balls import ball_kind, with_model
from ballfg.tracks import TABLE_TENNIS, Ball
from ballfg.tracks.info import TENNIS

SQUASH = """
name: squash
radius: 0.02
mass: 0.024
surface: court
flight: {gravity: {}, drag: {k: 0.016}}
bounce: {restitution: {e: 0.4}, friction: {mu: 0.5}}
launcher: {duration: 0.5}
"""


def test_tennis_balls_bounce_on_the_court_only() -> None:
    tracks = list(simulate(SimulationConfig(tracks=40, ball=tennis(), seed=1)))
    states = np.concatenate([t.true_states for t in tracks])
    assert states[:, 2].min() > TENNIS.radius - 1e-9
    assert np.abs(states[:, 0]).max() > 12.0  # they cross the net's place
    bounced = [np.any(np.diff(t.true_states[:, 5]) > 0.5) for t in tracks]
    assert np.mean(bounced) > 0.9


def test_tennis_restitution_is_seen_in_the_tracks() -> None:
    track = next(iter(simulate(SimulationConfig(tracks=1, ball=tennis(), rate=1000.0))))
    vz = track.true_states[:, 5]
    i = int(np.argmax(np.diff(vz)))
    assert vz[i + 1] / -vz[i] == pytest.approx(0.75, abs=0.01)


def test_ball_of_ones_own(tmp_path: Path) -> None:
    path = tmp_path / "squash.yaml"
    path.write_text(SQUASH)
    kind = ball_kind(str(path))
    assert (kind.name, kind.ball.mass, kind.surfaces.floor_height) == ("squash", 0.024, None)
    tracks = list(simulate(SimulationConfig(tracks=3, ball=kind)))
    assert max(t.track.duration for t in tracks) <= 0.5


def test_radius_and_mass_make_a_ball_with_the_nominal_model_of_such_a_ball(tmp_path: Path) -> None:
    path = tmp_path / "ball.yaml"

    def coefficients(model: AnalyticModel) -> dict[str, float]:
        return {name: float(value.detach()) for name, value in model.named_parameters()}

    path.write_text("radius: 0.03\nmass: 0.05\n")
    usual = coefficients(nominal_model(Ball(0.03, 0.05)))
    assert coefficients(ball_kind(str(path)).model) == usual
    assert usual["flight.drag.k"] > 0.01
    path.write_text("radius: 0.03\nmass: 0.05\nflight: {gravity: {}, drag: {k: 0.01}}\n")
    found = coefficients(ball_kind(str(path)).model)
    assert found["flight.drag.k"] == pytest.approx(0.01)
    assert found["bounce.restitution.e"] == usual["bounce.restitution.e"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("mass: 0.024", "", "key 'mass' is required"),
        ("mass: 0.024", "mass: 24", "probably in g"),
        ("mass:", "weight: 1\nmass:", "got 'weight'"),
        ("surface: court", "surface: lawn", "'table' or 'court'; got 'lawn'"),
        ("drag:", "drug:", "no flight effect 'drug'"),
        ("duration: 0.5", "durations: 0.5", "no field 'durations'"),
        ("{duration: 0.5}", "fast", "launcher must map"),
        ("name: squash", "inertia_factor: heavy", "inertia_factor must be a number"),
        ("name: squash", "name: [", "not readable as YAML"),
    ],
)
def test_ball_files_with_mistakes(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "ball.yaml"
    path.write_text(SQUASH.replace(old, new, 1))
    with pytest.raises((ValueError, TypeError), match=message) as caught:
        ball_kind(str(path))
    assert str(path) in str(caught.value)


def test_unknown_ball_lists_the_known_ones() -> None:
    with pytest.raises(FileNotFoundError, match=r"basketball, .* table-tennis, tennis, .* or a YAML file"):
        ball_kind("tenis")


def test_model_of_another_radius_is_refused() -> None:
    with pytest.raises(ValueError, match=r"radius 0\.0335 m; got 0\.02 m"):
        with_model(tennis(), nominal_model(0.02))


TRACKS = 3
DURATIONS = {"golf": 2.6}
"""s. Flights end before the ball comes to rest: at rest a state has no covariance to speak of."""
PROCESS = {"acceleration": 0.1, "spin": 1.0, "contact_velocity": 0.02, "contact_spin": 5.0}


@pytest.mark.parametrize("name", [name for name in KNOWN_BALLS if name not in ("table_tennis", "tennis")])
def test_flights_are_estimated_back_with_nees_in_bounds(name: str) -> None:
    kind = ball_kind(name)
    kind = replace(kind, launcher=replace(kind.launcher, duration=DURATIONS.get(name, 1.3)))
    config = SimulationConfig(
        tracks=TRACKS, seed=5, ball=kind, process=MotionNoise(**PROCESS), noise=MeasurementNoise(position=0.005)
    )
    settings = Settings(
        position_noise=(0.005,) * 3,
        process=ProcessNoise(**PROCESS),
        spin_label_noise=4.0,
        loss=Loss(),
        label_loss=Loss(),
        spin_loss=Loss(),
    )
    smoother = Smoother(kind.model, kind.surfaces, settings)
    means = []
    for simulated in simulate(config):
        estimate = smoother.estimate(simulated.track)
        assert estimate.status is Status.OK
        error = estimate.states - simulated.true_states
        means.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(estimate.covariances), error).mean())
        assert np.abs(error[:, :3]).max() < 0.03
    low, high = chi2.ppf([0.001, 0.999], 9 * TRACKS) / TRACKS
    assert low < np.mean(means) < high


@pytest.mark.parametrize("name", [name for name in KNOWN_BALLS if name != "table_tennis"])
def test_balls_bounce_on_the_ground_and_stay_above_it(name: str) -> None:
    kind = ball_kind(name)
    states = np.concatenate([t.true_states for t in simulate(SimulationConfig(tracks=20, ball=kind, seed=1))])
    assert states[:, 2].min() > kind.ball.radius - 1e-9
    assert (np.diff(states[:, 5]) > 0.5).sum() >= 10  # most of them bounce


def test_no_ball_takes_the_place_of_the_one_that_is_meant(tmp_path: Path) -> None:
    assert ball_kind("table-tennis").ball == TABLE_TENNIS
    with pytest.raises(ValueError, match="a badminton shuttle is no ball"):
        ball_kind("badminton")
