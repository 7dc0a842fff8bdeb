"""Camera factors: OpenCV's projection, derivatives against differences, a dense solution by scipy, wrong candidates."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from ballfg.factors.batch import COEFFICIENTS, Values, merge
from ballfg.factors.camera import FIXED, CameraFactors
from ballfg.factors.check import check_factor
from ballfg.factors.graph import BallGraph, LevenbergMarquardt
from ballfg.factors.loss import Loss
from ballfg.factors.prior import coefficient_prior, state_prior
from ballfg.state import POSITION, VELOCITY
from ballfg.vision.camera import Camera
from ballfg.vision.projection import CameraBank

MATRIX = [[1000.0, 0, 640.0], [0, 1010.0, 350.0], [0, 0, 1]]
RIG = (
    Camera("left", (1280, 720), MATRIX, [-0.2, 0.05, 0.001, -0.002, 0.01], [1.5, 0.2, -0.1], [0.1, 0.3, 3.0]),
    Camera("right", (1280, 720), MATRIX, [], [1.3, -0.9, 0.7], [-0.2, 0.3, 3.2]),
    Camera("wide", (1280, 720), MATRIX, [-0.1, 0.02, 0, 0, 0, 0.01, 0, 0], [1.2, 0.9, -0.7], [0.2, 0.2, 3.1]),
)
BANK = CameraBank(RIG)


def states(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    low, high = np.repeat((-0.4, -8.0, -100.0), 3), np.repeat((0.4, 8.0, 100.0), 3)
    return rng.uniform(low, high, (n, 9))


def factors(n: int = 6, offsets: bool = False, seed: int = 1, **changes: object) -> tuple[CameraFactors, Values]:
    """Sightings of n states, none of them where it should be, correlated noise, delays."""
    rng = np.random.default_rng(seed)
    x, camera = states(n), np.arange(n) % 3
    root = rng.uniform(0.2, 0.6, (n, 2, 2)) * [[1, 0], [0.3, 1]]
    pixels = np.stack([RIG[c].project(p) for c, p in zip(camera, x[:, POSITION], strict=True)])
    fields = {
        "states": np.arange(n),
        "camera": camera,
        "pixels": pixels + 2.0 * rng.standard_normal((n, 2)),
        "covariances": root @ root.swapaxes(-1, -2),
        "bank": BANK,
        "delay": rng.uniform(0, 2e-4, n),
        "columns": np.array([FIXED, 2, 1]) if offsets else None,
    }
    return CameraFactors(**(fields | changes)), Values(x, np.array([0.1, 0.002, -0.003]) if offsets else np.zeros(0))


@pytest.mark.parametrize("offsets", [False, True])
def test_residual_is_opencvs_whitened(offsets: bool) -> None:
    kind, values = factors(offsets=offsets)
    residual = kind.linearize(values).residual
    late = np.array([0.0, -0.003, 0.002]) if offsets else np.zeros(3)
    for k, x in enumerate(values.states):
        camera = RIG[k % 3]
        point = x[POSITION] + (kind.delay[k] - late[k % 3]) * x[VELOCITY]
        seen, _ = cv2.projectPoints(point[None], camera.rvec, camera.tvec, camera.matrix, camera.distortion)
        off = seen.ravel() - kind.pixels[k]
        covariance = np.linalg.inv(kind.root[k].T @ kind.root[k])
        assert residual[k] @ residual[k] == pytest.approx(off @ np.linalg.solve(covariance, off), rel=1e-9)


def radii(n: int, known: bool) -> dict[str, object]:
    """Radii in the picture of n sightings, one of them unknown; or none."""
    rows = np.column_stack((np.linspace(6.0, 9.0, n), np.full(n, 0.3)))
    rows[n // 2 :: n, 0] = 0.0
    return {"radii": rows, "ball": 0.02} if known else {}


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("offsets", [False, True])
@pytest.mark.parametrize("n", [1, 7])
def test_jacobians_agree_with_differences(n: int, offsets: bool, known: bool) -> None:
    """Five-point differences with a step of 1e-4 m: the projection's own terms beyond them are below 1e-9."""
    assert check_factor(*factors(n, offsets, **radii(n, known)), tolerance=1e-8) < 1e-8


def test_a_radius_is_that_of_the_outline() -> None:
    """The area of the projected outline of a ball gives its mean radius, to the per mille that a lens bends it."""
    kind, values = factors(**radii(6, True))
    residual = kind.linearize(values).residual
    assert residual.shape == (6, 3)
    assert residual[3, 2] == 0.0  # unknown
    for k in (0, 1, 2, 4, 5):
        camera, place = RIG[k % 3], values.states[k, POSITION] + kind.delay[k] * values.states[k, VELOCITY]
        plain = Camera("plain", camera.size, camera.matrix, [], camera.rvec, camera.tvec)
        ray = (place - camera.centre) / np.linalg.norm(place - camera.centre)
        side = np.linalg.svd(ray[None])[2][1:]
        turns = np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)
        ring = place + 0.02 * (np.cos(turns)[:, None] * side[0] + np.sin(turns)[:, None] * side[1])
        u, v = plain.project(ring).T
        mean = np.sqrt(0.5 * abs(np.sum(u * np.roll(v, 1) - v * np.roll(u, 1))) / np.pi)
        seen = kind.radii[k, 0] + residual[k, 2] / kind.radii[k, 1]
        assert seen == pytest.approx(mean, rel=0.05)


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("offsets", [False, True])
def test_torch_gives_the_same_residual_and_derivatives(offsets: bool, known: bool) -> None:
    kind, values = factors(offsets=offsets, **radii(6, known))
    inputs = tuple(np.array(values.gather(column)) for column in kind.variables.T)
    residual, jacobians = kind.compute(slice(None), inputs)
    tensors = tuple(torch.from_numpy(x).requires_grad_(True) for x in inputs)
    again = kind.residual(tensors)
    np.testing.assert_allclose(again.detach(), residual, atol=1e-9)
    for axis in range(kind.dim):
        slopes = torch.autograd.grad(again[:, axis].sum(), tensors, retain_graph=True)
        for slope, jacobian in zip(slopes, jacobians, strict=True):
            np.testing.assert_allclose(slope, jacobian[:, axis], atol=1e-8)


@pytest.mark.parametrize("known", [False, True])
def test_a_camera_that_moved_sees_as_one_that_stands_there(known: bool) -> None:
    """Each row's camera against a camera calibrated where it stood; with derivatives."""
    kind, values = factors(**radii(6, known), shifts=np.random.default_rng(3).uniform(-0.5, 0.5, (6, 3)))
    assert check_factor(kind, values, tolerance=1e-8) < 1e-8
    found = kind.linearize(values)
    there = [replace(RIG[k % 3], tvec=RIG[k % 3].tvec - RIG[k % 3].rotation @ kind.shifts[k]) for k in range(6)]
    other, _ = factors(
        **radii(6, known), camera=np.arange(6), bank=CameraBank([replace(c, name=str(k)) for k, c in enumerate(there)])
    )
    np.testing.assert_allclose(found.residual, other.linearize(values).residual, atol=1e-9)
    inputs = (torch.from_numpy(values.states.copy()),)
    np.testing.assert_allclose(kind.residual(inputs), found.residual, atol=1e-9)


def test_some_rows_and_merged_kinds_are_the_same_rows() -> None:
    kind, values = factors(offsets=True)
    other, _ = factors(offsets=True, seed=5)
    inputs = tuple(np.array(values.gather(column)) for column in kind.variables.T)
    rows = np.array([4, 1])
    whole, (by_state, by_offset) = kind.compute(slice(None), inputs)
    part, (part_state, part_offset) = kind.compute(rows, tuple(x[rows] for x in inputs))
    for some, all_rows in ((part, whole), (part_state, by_state), (part_offset, by_offset)):
        np.testing.assert_allclose(some, all_rows[rows], rtol=1e-12, atol=1e-12)
    assert kind.group == other.group
    both = merge([kind, other])
    joined, _ = both.compute(slice(None), tuple(np.concatenate((x, x)) for x in inputs))
    np.testing.assert_allclose(joined[6:], other.compute(slice(None), inputs)[0], rtol=1e-12)


def test_what_is_behind_a_camera_is_a_step_too_far() -> None:
    kind, values = factors(3)
    behind = values.states.copy()
    behind[0, POSITION] = RIG[0].centre - RIG[0].rotation[2]
    assert BallGraph((kind,)).error(Values(behind, values.coefficients)) == np.inf
    assert np.isfinite(BallGraph((kind,)).error(values))


def test_minimum_is_that_of_dense_least_squares() -> None:
    """Three sightings of one state, a prior, a time offset: scipy on the residuals alone finds the same point."""
    x = np.array([0.1, -0.2, 0.1, 5.0, 1.0, -2.0, 10.0, 20.0, 30.0])
    late = 0.002
    camera = np.array([0, 1, 2, 1])
    seen = [RIG[c].project(x[POSITION] - late * (c == 1) * x[VELOCITY]) for c in camera]
    pixels = np.array(seen) + 0.3 * np.random.default_rng(2).standard_normal((4, 2))
    spread = np.array([1, 1, 1, 0.1, 0.1, 0.1, 50, 50, 50])
    columns, zeros = np.array([FIXED, 0, FIXED]), np.zeros(4, dtype=np.int64)
    kind = CameraFactors(zeros, camera, pixels, np.tile(0.09 * np.eye(2), (4, 1, 1)), BANK, columns=columns)
    graph = BallGraph((kind, state_prior(0, x, spread), coefficient_prior(np.zeros(1), np.array([0.01]))))
    ours = LevenbergMarquardt().minimize(graph, Values(x[None] + 0.01, np.zeros(1)))

    def residuals(z: np.ndarray) -> np.ndarray:
        off = [
            (RIG[c].project(z[:3] - z[9] * (c == 1) * z[3:6]) - p) / 0.3 for c, p in zip(camera, pixels, strict=True)
        ]
        return np.concatenate((*off, (z[:9] - x) / spread, z[9:] / 0.01))

    scale = np.append(spread, 0.01)
    dense = least_squares(lambda s: residuals(s * scale), np.append(x, 0.0) / scale, xtol=1e-14, ftol=1e-14)
    theirs = dense.x * scale
    np.testing.assert_allclose(ours.values.states[0], theirs[:9], atol=1e-6, rtol=1e-6)
    np.testing.assert_allclose(ours.values.coefficients, theirs[9:], atol=1e-8)
    assert ours.error == pytest.approx(dense.cost, rel=1e-8)
    assert abs(ours.values.coefficients[0] - late) < 5e-4


def test_one_wrong_candidate_does_not_move_the_state() -> None:
    """Forty pixels off among nine sightings: Cauchy's loss leaves the point where the other eight have it."""
    x, rng = states(1), np.random.default_rng(3)
    camera = np.tile(np.arange(3), 3)
    pixels = np.array([RIG[c].project(x[0, POSITION]) for c in camera]) + 0.3 * rng.standard_normal((9, 2))
    pixels[4] += (30.0, -25.0)

    def point(rows: np.ndarray, loss: Loss) -> np.ndarray:
        noise = np.tile(0.09 * np.eye(2), (len(rows), 1, 1))
        kind = CameraFactors(np.zeros_like(rows), camera[rows], pixels[rows], noise, BANK, loss=loss)
        graph = BallGraph((kind, state_prior(0, x[0], np.repeat((1.0, 10.0, 60.0), 3))))
        return LevenbergMarquardt().minimize(graph, Values(x, np.zeros(0))).values.states[0, POSITION]

    everything, others = np.arange(9), np.delete(np.arange(9), 4)
    robust, squared = Loss("cauchy", 5.0), Loss()
    assert np.linalg.norm(point(everything, robust) - point(others, robust)) < 1e-4
    assert np.linalg.norm(point(everything, squared) - point(others, squared)) > 5e-3


def test_offsets_are_the_coefficients_that_the_columns_name() -> None:
    kind, values = factors(offsets=True)
    assert (kind.variables[:, 1] == COEFFICIENTS).all()
    by_offset = kind.linearize(values).jacobians[1]
    assert by_offset.shape == (6, 2, 3)
    assert not by_offset[::3].any()
    assert not by_offset[1::3, :, :2].any()
    assert not by_offset[2::3, :, [0, 2]].any()


def test_refuses_arrays_that_do_not_fit() -> None:
    with pytest.raises(ValueError, match=r"must have shapes \(6,\), \(6, 2\) and \(6, 2, 2\)"):
        factors(pixels=np.zeros((5, 2)))
