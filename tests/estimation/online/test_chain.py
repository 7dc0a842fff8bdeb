"""The chain of triangles against iSAM2, sample by sample: the same factors at the same points, the same answers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ballfg.dynamics import Surfaces, nominal_model
from ballfg.estimation import Online, RadarSpeed, Settings
from ballfg.estimation.online.windows.chain import ChainWindow
from ballfg.estimation.result import Status
from ballfg.estimation.settings import Solver
from ballfg.factors.loss import Loss
from ballfg.simulation import SimulationConfig, simulate
from ballfg.tracks import Track
from tests.estimation.observations.sighted_rig import RIG, World, scene, world

SAME = 1e-6
"""Standard deviations, and shares of the largest covariance."""


@pytest.fixture(scope="module")
def track() -> Track:
    (shot,) = simulate(SimulationConfig(tracks=1, rate=60.0, seed=3))
    return shot.track


@pytest.fixture(scope="module")
def ball() -> World:
    return world()


def both(model: Any, surfaces: Any, settings: Settings, **more: Any) -> tuple[Online, Online]:
    """Two online estimators that differ in their solvers alone."""
    chosen = (replace(settings, solver="gtsam"), replace(settings, solver="ballfg"))
    return Online(model, surfaces, chosen[0], **more), Online(model, surfaces, chosen[1], **more)


def same(one: Any, other: Any) -> None:
    sigma = np.sqrt(np.diag(one.joint))
    assert (np.abs(one.mean - other.mean) / sigma).max() < SAME
    assert (np.abs(one.joint - other.joint) / np.outer(sigma, sigma)).max() < SAME
    np.testing.assert_allclose(one.innovation, other.innovation, atol=SAME)
    assert (one.status, one.revised) == (other.status, other.revised)


def own(model: Any, **changes: Any) -> Settings:
    return replace(Settings.for_measured(model), **changes)


CASES = {
    "robust": {},
    "squared": {"loss": Loss()},
    "no coefficients": {"coefficients": {}},
    "memory": {"memory": (0.002,) * 3, "stamp_jitter": 1e-4},
}


@pytest.mark.parametrize("changes", CASES.values(), ids=CASES)
@pytest.mark.parametrize("lag", [12, 128])
def test_through_bounces_and_cuts_of_the_window(track: Track, changes: dict[str, Any], lag: int) -> None:
    model = nominal_model()
    one, other = both(model, 0.0, own(model, **changes), lag=lag)
    for time, position in zip(track.times, track.positions, strict=True):
        same(one.push(time, position), other.push(time, position))
    assert isinstance(other.window, ChainWindow)
    assert one.window is not None
    np.testing.assert_allclose(other.window.states, one.window.states, atol=1e-5)


@pytest.mark.parametrize("memory", [0.0, 0.002])
def test_gaps_hits_and_outliers(track: Track, memory: float) -> None:
    """Shots with a pause that restarts, a hit by the other player, and a sample that is far off."""
    model, rng = nominal_model(), np.random.default_rng(0)
    one, other = both(model, 0.0, own(model, memory=(memory,) * 3), lag=20)
    clock = 0.0
    for shot in range(4):
        for k, (time, position) in enumerate(zip(track.times, track.positions, strict=True)):
            off = 0.3 * rng.standard_normal(3) if k == 9 else np.zeros(3)
            turned = position * ((-1.0) ** shot, 1.0, 1.0) + off
            same(one.push(clock + time, turned), other.push(clock + time, turned))
        clock += track.times[-1] + (0.02 if shot % 2 else 1.5)


def test_cuts_where_later_states_were_eliminated_before_the_leaving_ones() -> None:
    """A tracker's bias links shots over their pause; iSAM2's tree then has states that stay below ones that leave."""
    model, config = nominal_model(), SimulationConfig(tracks=2, rate=200.0, seed=15)
    chosen = Settings.for_measured(model, position_noise=(0.003,) * 3, memory=(0.004,) * 3, memory_time=0.05)
    one, other = both(model, config.ball.surfaces, chosen, lag=20)
    clock = 0.0
    for shot in simulate(config):
        for time, position in zip(shot.track.times, shot.track.positions, strict=True):
            state = one.push(clock + time, position)
            same(state, other.push(clock + time, position))
            assert not state.rebuilt
        clock += shot.track.times[-1] + 0.3


def test_measurements_of_a_moment(track: Track) -> None:
    model = nominal_model()
    one, other = both(model, 0.0, own(model))
    for k, (time, position) in enumerate(zip(track.times, track.positions, strict=True)):
        speed = np.linalg.norm(position - track.positions[max(k - 1, 0)]) * 60.0
        seen = [RadarSpeed(0, speed, 0.2)] if k % 3 == 2 else []
        same(one.push(time, position, observations=seen), other.push(time, position, observations=seen))


def test_sightings_that_join_a_sample(ball: World) -> None:
    made = scene(2, ball, phases=(0.0, 0.0, 0.0), duration=0.4)
    one, other = both(ball.model, ball.surfaces, Settings(), cameras=RIG, lag=15)
    seen = made.sightings
    for t, c, z, noise in zip(seen.times, seen.camera, seen.pixels, seen.covariances, strict=True):
        states = [online.push_sighting(t, seen.cameras[c], z, noise) for online in (one, other)]
        assert (states[0] is None) == (states[1] is None)
        if states[0] is not None:
            same(*states)


def test_a_window_that_begins_where_a_shot_begins_knows_nothing_of_the_shot_before(track: Track) -> None:
    """The cut after 25 samples leaves the 12 of the next shot; a window that keeps all says the same of them."""
    model, states = nominal_model(), {}
    settings = own(model, memory=(0.002,) * 3, coefficients={}, loss=Loss())
    times = np.concatenate((track.times[:13], track.times[:20] + 3.0))
    positions = np.concatenate((track.positions[:13], track.positions[:20]))
    for name, lag in (("cut", 12), ("whole", 128)):
        one, other = both(model, 0.0, settings, lag=lag)
        for time, position in zip(times, positions, strict=True):
            states[name] = one.push(time, position)
            same(states[name], other.push(time, position))
        assert one.window is not None
        assert one.window.first == (13 if name == "cut" else 0)
    sigma = np.sqrt(np.diag(states["whole"].joint))
    assert (np.abs(states["cut"].mean - states["whole"].mean) / sigma).max() < 0.02


@pytest.mark.parametrize("lag", [12, 128])
@pytest.mark.parametrize("changes", [{}, {"coefficients": {}}], ids=["coefficients", "none"])
def test_estimates_of_whole_tracks(track: Track, lag: int, changes: dict[str, Any]) -> None:
    model = nominal_model()
    one, other = (online.estimate(track) for online in both(model, 0.0, own(model, **changes), lag=lag))
    assert one.status is other.status is Status.OK
    sigmas = one.sigmas
    assert (np.abs(one.states - other.states) / sigmas).max() < 1e-4  # the minimum within the smoother's tolerance
    apart = np.abs(one.covariances - other.covariances)
    assert (apart / (sigmas[:, :, None] * sigmas[:, None])).max() < 1e-4


def test_what_cannot_be_solved_is_built_anew(track: Track, monkeypatch: pytest.MonkeyPatch) -> None:
    model = nominal_model()
    online, undisturbed = (Online(model, 0.0, replace(own(model), solver="ballfg")) for _ in range(2))
    for k, (time, position) in enumerate(zip(track.times, track.positions, strict=True)):
        expected = undisturbed.push(time, position)
        if k == 20:
            assert isinstance(online.window, ChainWindow)
            online.window._chain[0][:21] = np.nan
        state = online.push(time, position)
        assert state.rebuilt == (k == 20)
    assert (np.abs(state.mean - expected.mean) / np.sqrt(np.diag(expected.joint)) < 1.0).all()


@pytest.mark.parametrize(("earlier", "solver"), [("isam2", "gtsam"), ("chain", "ballfg")])
def test_earlier_names_of_solvers_warn_and_work(track: Track, earlier: str, solver: Solver) -> None:
    model = nominal_model()
    with pytest.warns(DeprecationWarning, match=f"write Settings\\(solver='{solver}'\\)"):
        one = Online(model, 0.0, own(model), solver=earlier)
    other = Online(model, 0.0, replace(own(model), solver=solver))
    for time, position in zip(track.times[:20], track.positions[:20], strict=True):
        before, now = one.push(time, position), other.push(time, position)
    assert type(one.window) is type(other.window)
    assert np.array_equal(before.mean, now.mean)


def test_an_unknown_solver_is_refused() -> None:
    with pytest.raises(ValueError, match="isam2, chain"):
        Online(nominal_model(), Surfaces(0.0), solver="cholmod")
