"""GTSAM's solver beside the package's own, and the graph of a track with factors of a user's in it."""

from __future__ import annotations

import gc
import re
import weakref
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

import ballfg as bf
from ballfg.dynamics import EFFECTS
from ballfg.estimation.online.windows.chain import ChainWindow
from ballfg.estimation.online.windows.window import IsamWindow
from ballfg.estimation.segmentation.result import Contact, Segmentation
from ballfg.estimation.smoother.second_look.low_hops import LowHops
from ballfg.factors import LevenbergMarquardt
from ballfg.factors.gtsam_solver import GtsamLevenbergMarquardt
from ballfg.factors.loss import Loss
from ballfg.simulation import SimulationConfig
from ballfg.tracks.dataset import dataset_in_memory
from ballfg.tracks.info import DatasetInfo
from tests.estimation.gtsam_solver import SAME, Solvers, difference, distance, simulated
from tests.estimation.observations.sighted_rig import scene, track_of, world
from tests.places import DOCS

NOISE = (0.003, 0.003, 0.003)
TABLE = 0.76
LENS = gtsam.Cal3_S2(900.0, 900.0, 0.0, 640.0, 512.0)  # px
POSE = gtsam.symbol("p", 0)
PIXEL = 0.5
"""px, noise of the camera's pixels."""


def shots(count: int, seed: int = 3) -> list[bf.Track]:
    return [shot.track for shot in bf.simulate(SimulationConfig(tracks=count, rate=60.0, seed=seed))]


def settings(**changes: Any) -> bf.Settings:
    return bf.Settings.for_measured(bf.nominal_model(), **{"position_noise": NOISE, **changes})


# --- the solver --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("changes", [{}, {"memory": (0.002,) * 3, "stamp_jitter": 1e-4}], ids=["plain", "memory"])
def test_both_solvers_find_the_same_estimate(changes: dict[str, Any]) -> None:
    solvers = Solvers.of(bf.nominal_model(), bf.Surfaces.table_tennis(TABLE), settings(**changes))
    assert isinstance(solvers.gtsam.optimizer, GtsamLevenbergMarquardt)
    for number, track in enumerate(shots(3)):
        given = replace(track, labels={}) if number else track
        found = difference(solvers, given)
        assert found.gtsam < SAME
        assert found.contacts[0] == found.contacts[1] >= 1
    own, other = solvers.tight.estimate(given), solvers.gtsam.estimate(given)
    np.testing.assert_allclose(other.sigmas, own.sigmas, rtol=1e-5)
    np.testing.assert_allclose(other.innovations["position"], own.innovations["position"], atol=1e-4)


def test_both_solvers_agree_on_the_program_s_tracks() -> None:
    assert max(found.gtsam for found in simulated(3, seed=1)) < SAME


def test_both_solvers_agree_on_what_cameras_saw() -> None:
    """Cauchy's loss on pixels, one of which is another ball's."""
    ball = world()
    made = scene(1, ball)
    pixels = made.sightings.pixels.copy()
    pixels[40] += 60.0
    track = track_of(made._replace(sightings=replace(made.sightings, pixels=pixels)))
    own = bf.Smoother(*ball, settings(), LevenbergMarquardt(tolerance=1e-8)).estimate(track)
    other = bf.Smoother(*ball, settings(solver="gtsam")).estimate(track)
    assert distance(own, other) < SAME


@pytest.mark.parametrize(("solver", "window"), [(None, IsamWindow), ("gtsam", IsamWindow), ("ballfg", ChainWindow)])
def test_the_settings_choose_what_holds_the_online_window(solver: Any, window: type) -> None:
    (track,) = shots(1)
    online = bf.Online(bf.nominal_model(), TABLE, settings(solver=solver))
    for time, position in zip(track.times[:10], track.positions[:10], strict=True):
        online.push(time, position)
    assert isinstance(online.window, window)
    live = bf.Tracker(bf.nominal_model(), TABLE, settings(solver=solver))
    assert live.estimator.settings.solver == (solver or "ballfg")


def test_an_online_estimate_by_gtsam_alone_is_the_smoother_s() -> None:
    (track,) = shots(1)
    own = bf.Smoother(bf.nominal_model(), TABLE, settings(), LevenbergMarquardt(tolerance=1e-8)).estimate(track)
    assert distance(own, bf.Online(bf.nominal_model(), TABLE, settings(solver="gtsam")).estimate(track)) < SAME


def test_what_gtsam_cannot_solve_is_refused() -> None:
    (track,) = shots(1)
    for method in ("ekf", "sliding-window"):
        with pytest.raises(ValueError, match=f"for the estimator '{method}', which has no factor graph"):
            bf.estimate(track, method=method, surfaces=TABLE, settings=settings(solver="gtsam"))
        assert bf.estimate(track, method=method, surfaces=TABLE, settings=settings(solver="ballfg")).states.any()
    with pytest.raises(ValueError, match="solver must be one of ballfg, gtsam; got 'isam2'"):
        settings(solver="isam2")


# --- the graph ---------------------------------------------------------------------------------------------------


def solved(graph: bf.TrackGraph) -> gtsam.Values:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    return gtsam.LevenbergMarquardtOptimizer(graph.factors, graph.values, parameters).optimize()


@pytest.mark.parametrize("memory", [0.0, 0.002])
def test_there_and_back_is_the_smoother_s_estimate(memory: float) -> None:
    """Squared losses, whose curvature GTSAM's marginals hold; stamps that begin anywhere."""
    (track,) = shots(1)
    track = replace(track, times=track.times + 100.0)
    calm = settings(loss=Loss("squared"), spin_loss=Loss("squared"), label_loss=Loss("squared"), memory=(memory,) * 3)
    expected = bf.estimate(track, surfaces=TABLE, settings=calm)
    graph = bf.graph(track, surfaces=TABLE, settings=calm)
    assert graph.coefficients == expected.coefficient_names
    assert np.array_equal(graph.times, track.times)
    assert [gtsam.Symbol(key).index() for key in graph.keys.tolist()] == list(range(len(track)))
    found = bf.Estimate.from_gtsam(graph, solved(graph))
    assert found.status is bf.Status.OK
    assert distance(expected, found) < 1e-4
    np.testing.assert_allclose(found.sigmas, expected.sigmas, rtol=1e-4)
    np.testing.assert_allclose(found.coefficient_covariance, expected.coefficient_covariance, rtol=1e-4, atol=1e-12)
    assert found.error == pytest.approx(expected.error, rel=1e-9)
    times = [[contact.time for contact in one.contacts] for one in (found, expected)]
    np.testing.assert_allclose(*times, atol=1e-6)
    assert found.last.joint.shape == expected.last.joint.shape


def test_values_that_are_no_minimum_have_a_status() -> None:
    (track,) = shots(1)
    graph = bf.graph(track, surfaces=TABLE, settings=settings())
    graph.values.update(int(graph.keys[3]), graph.values.atVector(int(graph.keys[3])) + 0.1)
    assert bf.Estimate.from_gtsam(graph, graph.values).status is bf.Status.NOT_CONVERGED


def test_what_is_no_solution_of_the_graph_is_refused() -> None:
    first, second = (bf.graph(track, surfaces=TABLE, settings=settings()) for track in shots(2))
    few = gtsam.Values()
    for key in first.keys.tolist()[:-2]:
        few.insert(key, first.values.atVector(key))
    with pytest.raises(
        ValueError, match=r"values must hold every variable of the graph's \d+; [23] are missing, such as"
    ):
        bf.Estimate.from_gtsam(first, few)
    with pytest.raises(TypeError, match=r"values must be a Values; got TrackGraph .* Give the result of an optimizer"):
        bf.Estimate.from_gtsam(first, second)
    with pytest.raises(
        TypeError, match=r"graph must be a TrackGraph; got NonlinearFactorGraph .* Take bf.graph\(track\)"
    ):
        bf.Estimate.from_gtsam(first.factors, first.values)


def sighting(key: int, pixel: np.ndarray) -> gtsam.CustomFactor:
    def error(_: Any, values: gtsam.Values, jacobians: Any) -> np.ndarray:
        by_pose, by_point, by_lens = (np.zeros((2, d), order="F") for d in (6, 3, 5))
        camera = gtsam.PinholeCameraCal3_S2(values.atPose3(POSE), LENS)
        seen = camera.project(values.atVector(key)[:3], by_pose, by_point, by_lens)
        if jacobians is not None:
            jacobians[0], jacobians[1] = by_pose, np.hstack((by_point, np.zeros((2, 6))))
        return np.asarray(seen - pixel)

    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(2, PIXEL), [POSE, key], error)


def test_a_camera_s_pose_is_found_with_the_ball_as_exactly_as_it_says() -> None:
    """Over several flights the errors of the pose are as large as their covariance has them, and so are the ball's."""
    lookat, rng = gtsam.PinholeCameraCal3_S2.Lookat, np.random.default_rng(2)
    squares, errors = [], []
    for shot in bf.simulate(SimulationConfig(tracks=10, rate=60.0, seed=8)):
        place = np.array([1.4, -3.0, 1.2]) + rng.uniform(-0.3, 0.3, 3)
        true = lookat(place, np.array([1.4, 0.0, 0.9]), np.array([0.0, 0.0, 1.0]), LENS)
        graph = bf.graph(shot.track, surfaces=TABLE, settings=settings())
        alone = bf.Estimate.from_gtsam(graph, graph.values)
        for key, state in zip(graph.keys.tolist(), shot.true_states, strict=True):
            graph.factors.push_back(sighting(key, true.project(state[:3]) + PIXEL * rng.standard_normal(2)))
        graph.values.insert(POSE, true.pose().retract(np.array([0.1, -0.1, 0.05, 0.3, -0.2, 0.2])))
        values = solved(graph)
        off = values.atPose3(POSE).localCoordinates(true.pose())
        covariance = gtsam.Marginals(graph.factors, values).marginalCovariance(POSE)
        squares.append(off @ np.linalg.solve(covariance, off))
        found = bf.Estimate.from_gtsam(graph, values)
        assert found.status is bf.Status.OK
        assert found.sigmas[:, 0].mean() < 0.95 * alone.sigmas[:, 0].mean()
        errors.append([np.square((one.states - shot.true_states)[:, :3]).mean() for one in (alone, found)])
    assert 2.7 < np.mean(squares) < 9.3  # chi-square with 6 degrees of freedom, the mean of 10: 6 +- 1.1
    assert np.mean(errors, axis=0)[1] < np.mean(errors, axis=0)[0]


def test_the_graph_s_objects_live_as_long_as_anyone_holds_them() -> None:
    (track,) = shots(1)
    graph = bf.graph(track, surfaces=TABLE, settings=settings())
    factors, values, watched = graph.factors, graph.values, weakref.ref(graph._solution.graph.batches[0])
    error = factors.error(values)
    del graph
    gc.collect()
    assert watched() is not None
    assert factors.error(values) == error
    del factors
    gc.collect()
    assert watched() is None


def test_tracks_without_a_graph_are_refused() -> None:
    (track,) = shots(1)
    data = dataset_in_memory(DatasetInfo("a", TABLE, bf.Ball(0.02, 0.0027)), [track])
    with pytest.raises(TypeError, match="must be one track; got a dataset"):
        bf.graph(data)  # type: ignore[arg-type]
    nominal = bf.nominal_model()
    tilted = bf.AnalyticModel([*nominal.flight.values(), *nominal.bounce.values(), EFFECTS["frame_tilt"](x=0.01)])
    with pytest.raises(ValueError, match=r"no measurement effects for a graph.* call bf\.estimate"):
        bf.graph(track, model=tilted, surfaces=TABLE)
    assert bf.estimate(track, model=tilted, surfaces=TABLE, settings=settings()).status is bf.Status.OK
    with pytest.raises(ValueError, match="track '000': the objective is not finite at the start"):
        bf.TrackGraph.of(Impossible(bf.nominal_model(), TABLE, settings()), track)


def test_the_tutorial_s_camera_takes_a_tracker_with_memory_too(capsys: pytest.CaptureFixture[str]) -> None:
    """The state then has 12 numbers; a Jacobian for 9 of them makes GTSAM's system indeterminate."""
    text = (DOCS / "tutorials" / "7_a_camera_by_gtsam.md").read_text(encoding="utf-8")
    code = "".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))
    exec(compile(code.replace("position_noise=", "memory=(0.002,) * 3, position_noise="), "tutorial", "exec"), {})
    assert "within 3 sigma: True" in capsys.readouterr().out


def test_of_a_recording_the_graph_is_that_of_a_flight() -> None:
    """A ball is held, thrown and caught; the graph of all of it would be one flight with hits in the hand."""
    times = np.arange(240) / 100
    flown = np.clip(times - 0.8, 0.0, 0.8)[:, None]
    path = [0.0, 0.0, 1.5] + flown * [3.0, 0.0, 4.0] - flown**2 * [0.0, 0.0, 4.905]
    recording = bf.Track(times, path + np.random.default_rng(0).normal(0.0, 0.002, path.shape))
    with pytest.raises(ValueError, match=r"must be one flight; got a ball that is also held.* of bf.flights\(track"):
        bf.graph(recording)
    (flight,) = bf.flights(recording)
    graph = bf.graph(flight)
    assert np.allclose(bf.Estimate.from_gtsam(graph, graph.values).states[:, 3], 3.0, atol=0.2)


class Impossible(bf.Smoother):
    """Says that the ball bounces on a surface 60 m below."""

    def _segmented(self, track: bf.Track) -> tuple[Segmentation, tuple[LowHops, ...]]:
        found, hops = super()._segmented(track)
        return replace(found, contacts=(Contact(8, float(track.times[8]), -60.0),)), hops
