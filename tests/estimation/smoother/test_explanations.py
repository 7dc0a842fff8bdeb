"""How often a ball bounced before one camera, and how far away it was: against flights by other equations of motion."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest

from ballfg.dynamics import Surfaces
from ballfg.dynamics.nominal import nominal_model
from ballfg.estimation.observations.sightings import sighted_track
from ballfg.estimation.result import Estimate, Status
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.second_look.at_end import log_evidence
from ballfg.estimation.smoother.second_look.explanations import Depths, Held, log_prior_of_size, over_depths
from ballfg.estimation.smoother.second_look.gaps import OPEN
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.batch import Values
from ballfg.factors.linear.covariance import Covariances
from ballfg.tracks.sightings import Sightings
from ballfg.tracks.track import Track
from ballfg.vision.camera import Camera
from tests.estimation.nees import nees
from tests.estimation.observations.sighted_rig import looking

ENDS = (-0.7625, 0.7625, -1.37, 1.37)
RADIUS, GRAVITY, STEP = 0.02, 9.81, 1e-3
MODEL = nominal_model()
SMOOTHER = Smoother(MODEL, Surfaces(0.0, -0.76, ENDS), Settings.for_measured(MODEL))
PLACES = {"behind": ((0.5, -9.0, 2.4), 2300.0), "beside": ((4.4, 0.3, 1.6), 1100.0), "above": ((0.2, -0.2, 3.4), 800.0)}


@dataclass(frozen=True)
class Seen:
    """A track of one camera with the true positions (n, 3) m at its samples, and the time, s, of the first bounce."""

    track: Track
    truth: np.ndarray
    bounced: float
    place: np.ndarray

    def bounces(self) -> int:
        """Number of bounces between its samples; none of these strokes bounces twice."""
        return int(self.bounced < self.track.times[-1])

    def depth(self, found: Estimate) -> float:
        """Error of the distance from the camera in the middle of the track, in standard deviations."""
        middle = len(self.truth) // 2
        ray = self.truth[middle] - self.place
        ray /= np.linalg.norm(ray)
        error = found.states[middle, :3] - self.truth[middle]
        return float(ray @ error / np.sqrt(ray @ found.covariances[middle, :3, :3] @ ray))


def flown(
    start: np.ndarray, spin: np.ndarray, drag: float, magnus: float, moments: np.ndarray
) -> tuple[np.ndarray, float]:
    """Positions (n, 3) m of a stroke by steps of the midpoint rule, and the time, s, of its first bounce; z up."""

    def moved(state: np.ndarray) -> np.ndarray:
        velocity = state[3:]
        air = -drag * np.linalg.norm(velocity) * velocity + magnus * np.cross(spin, velocity)
        return np.concatenate((velocity, air - [0.0, 0.0, GRAVITY]))

    state, time, found, bounced = start.copy(), 0.0, [], math.inf
    for moment in moments:
        while time < moment - 1e-9:
            step = min(STEP, moment - time)
            state, time = state + step * moved(state + 0.5 * step * moved(state)), time + step
            inside = ENDS[0] <= state[0] <= ENDS[1] and ENDS[2] <= state[1] <= ENDS[3]
            if state[2] < RADIUS and state[5] < 0.0 and inside:
                state[2], state[5] = 2.0 * RADIUS - state[2], -0.92 * state[5]
                state[3:5] *= 0.75
                bounced, spin = min(bounced, time), 0.6 * spin
        found.append(state[:3])
    return np.array(found), bounced


def strokes(view: str, count: int, seed: int) -> Iterator[Seen]:
    """Strokes along y with topspin or backspin at 30 to 120 Hz, seen for 0.25 to 0.5 s with 0.5 to 2 px of noise."""
    rng = np.random.default_rng(seed)
    place, focal = PLACES[view]
    camera = replace(looking(view, place), matrix=np.array([[focal, 0.0, 640.0], [0.0, focal, 360.0], [0.0, 0.0, 1.0]]))
    while count:
        rate, noise, last = rng.choice([30.0, 60.0, 120.0]), rng.choice([0.5, 1.0, 2.0]), rng.uniform(0.25, 0.5)
        speed, rise = rng.uniform(3.0, 9.0), rng.uniform(0.0, 1.5)
        start = np.array([rng.uniform(-0.5, 0.5), -1.3, rng.uniform(0.15, 0.45), rng.normal(0.0, 0.4), speed, rise])
        spin = np.array([rng.normal(-40.0, 100.0), rng.normal(0.0, 20.0), rng.normal(0.0, 20.0)])
        moments = np.arange(0.0, last, 1.0 / rate)
        truth, bounced = flown(start, spin, rng.normal(0.13, 0.01), rng.normal(0.003, 0.0005), moments)
        if abs(bounced - moments[-1]) < 1.5 / rate or bounced < 0.1:  # so near an end nothing shows it
            continue
        pixels = camera.project(truth) + noise * rng.standard_normal((len(truth), 2))
        yield Seen(filmed(camera, moments, pixels, noise), truth, bounced, np.array(place))
        count -= 1


def filmed(
    camera: Camera, moments: np.ndarray, pixels: np.ndarray, noise: float, radii: np.ndarray | None = None
) -> Track:
    """The track of pixels (n, 2) with a noise, px, that they state; radii: (n, 2) px with sigmas."""
    spread = np.tile(noise**2 * np.eye(2), (len(moments), 1, 1))
    seen = Sightings((camera.name,), np.zeros(len(moments), dtype=np.int64), moments, pixels, spread, radii)
    return sighted_track("a", seen, [camera], model=MODEL, surfaces=SMOOTHER.surfaces)


@pytest.mark.parametrize(
    "view", ["beside", *(pytest.param(v, marks=pytest.mark.thorough) for v in PLACES if v != "beside")]
)
def test_the_number_of_bounces_and_the_distance_hold(view: str) -> None:
    """No bounce is invented; distances are neither too short nor too long, and lie within what is stated."""
    extra, missed, inside, depths, sizes = 0, 0, [], [], []
    for seen in strokes(view, 14, 3):
        found = SMOOTHER.estimate(seen.track)
        number = len(found.contacts) - seen.bounces()
        extra, missed = extra + (number > 0), missed + (number < 0)
        if number:
            assert OPEN in found.notes
        error = found.states[:, :3] - seen.truth
        inside.append((np.abs(error) < 1.645 * found.sigmas[:, :3]).mean(axis=0))
        sizes.append(nees(found, seen.truth, slice(0, 3)).mean())
        depths.append(seen.depth(found))
    assert extra == 0
    assert missed <= 2
    assert (np.mean(inside, axis=0) > 0.85).all()
    assert np.mean(sizes) < 4.0  # of three coordinates
    assert abs(np.mean(depths)) < 0.6
    assert np.sqrt(np.mean(np.square(depths))) < 1.4


def test_distances_add_up_to_the_evidence_where_it_is_known() -> None:
    """Where radii show the distance to two per cent, all distances together are what Laplace's approximation says."""
    seen = next(one for one in strokes("beside", 9, 9) if not one.bounces())
    camera = replace(looking("beside", PLACES["beside"][0]), matrix=np.diag([1100.0, 1100.0, 1.0]))
    radii = np.column_stack((1100.0 * RADIUS / camera.depth(seen.truth), np.full(len(seen.truth), 0.3)))
    track = filmed(camera, seen.track.times, camera.project(seen.truth), 0.5, radii)
    problem = next(
        one for one in SMOOTHER.problems(SMOOTHER.prepared(track).since_first()) if not one.segmentation.contacts
    )
    solution = SMOOTHER.settle(problem)
    found = over_depths(SMOOTHER, problem, solution)
    assert found is not None
    assert 0.01 < found.sigma < 0.02
    whole = log_evidence(solution) + log_prior_of_size(problem, solution.minimum.values)
    assert found.evidence == pytest.approx(whole, abs=0.05)
    estimate = SMOOTHER.at_minimum(problem, solution, SMOOTHER.optimizer.covariances(solution.graph, solution.minimum))
    moved = found.onto(estimate)
    assert (np.abs(moved.states - estimate.states) < 0.3 * estimate.sigmas).all()
    np.testing.assert_allclose(moved.sigmas[:, :3], estimate.sigmas[:, :3], rtol=0.1)


def test_the_mean_of_paths_and_their_covariance() -> None:
    """By hand: two paths with weights 3 : 1, one of them half hidden by a surface."""
    estimate = SMOOTHER.estimate(next(strokes("beside", 1, 1)).track)
    n, p = len(estimate), len(estimate.coefficients)
    known = Covariances(np.tile(np.eye(9), (n, 1, 1)), 2.0 * np.eye(p), np.zeros((n, 9, p)))
    one, other = (Values(np.full((n, 9), x), np.full(p, x)) for x in (0.0, 4.0))
    paths = Held(0.0, 0.0, one, known), Held(math.log(2.0 / 3.0), math.log(0.5), other, known)
    found = Depths(paths, 0.5)
    np.testing.assert_allclose(found.weights, [0.75, 0.25])
    assert found.evidence == pytest.approx(math.log((1.0 + 1.0 / 3.0) * 0.5))
    assert found.sigma == pytest.approx(0.5 * math.sqrt(0.75 * 0.25))
    mixed = found.onto(replace(estimate, status=Status.NOT_CONVERGED))
    assert mixed.status is Status.OK
    assert found.onto(replace(estimate, status=Status.DEPTH_UNCERTAIN)).status is Status.DEPTH_UNCERTAIN
    np.testing.assert_allclose(mixed.states, 1.0)
    np.testing.assert_allclose(mixed.covariances[0], np.eye(9) + 3.0)
    np.testing.assert_allclose(mixed.coefficient_covariance, 2.0 * np.eye(p) + 3.0)
    np.testing.assert_allclose(mixed.cross_covariances[-1], 3.0)


def test_a_path_that_no_search_reached_has_no_evidence() -> None:
    """Near the camera searches end on slopes; their determinants once put a ball there, 2.5 m off at a stated 6 cm."""
    camera = looking("above", PLACES["above"][0])
    moments = np.arange(0.0, 0.21, 1.0 / 90.0)
    start = np.array([0.2, -1.4, 0.35, 0.0, 3.2, 0.6])
    truth, _ = flown(start, np.array([-60.0, 0.0, 0.0]), 0.13, 0.003, moments)
    for seed in range(6):
        pixels = camera.project(truth) + 2.0 * np.random.default_rng(seed).standard_normal((len(truth), 2))
        track = filmed(camera, moments, pixels, 2.0)
        problem = SMOOTHER.problems(SMOOTHER.prepared(track).since_first())[0]
        found = over_depths(SMOOTHER, problem, SMOOTHER.settle(problem))
        assert found is not None
        assert found.paths[int(found.weights.argmax())].values.states[0, 2] < 2.9  # half a metre below the camera
        assert found.sigma > 0.05
