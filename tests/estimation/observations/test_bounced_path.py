"""Paths about bounces in machine code, against least squares on residuals that are written out flight by flight."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from ballfg.arrays import Array
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.observations.bounced_code import (
    FRICTION_SIGMA,
    KEPT,
    LAWS,
    PLANE_SIGMA,
    RESTITUTION_SIGMA,
    SPEED,
    STRETCH_LIMIT,
)
from ballfg.estimation.observations.bounced_path import LIFT, Scene, place_prior, solved
from ballfg.estimation.observations.ray_path import NEAREST, ROBUST, ROUNDS, Rays
from ballfg.estimation.segmentation.physics import SegmentationPhysics

TABLE = Surfaces(0.0, -0.76, (-1.37, 1.37, -0.7625, 0.7625))
BALL = SegmentationPhysics()


def rays(rng: np.random.Generator, count: int) -> Rays:
    """Rays of a camera 9 m beside the table, through places about it, with a noise of about a pixel of 1000."""
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.4, -np.sqrt(0.84)], [0.0, np.sqrt(0.84), 0.4]])
    places, shift = rng.uniform((-1.5, -0.5, 0.05), (1.5, 0.5, 0.6), (count, 3)), np.array([0.0, 0.0, 9.0])
    seen = places @ turn.T + shift
    plane = seen[:, :2] / seen[:, 2:] + rng.normal(0.0, 1e-3, (count, 2))
    root = 1e3 * (np.eye(2) + 0.2 * rng.normal(size=(count, 2, 2)))
    target, depth = plane * shift[2] - shift[:2], np.tile(np.append(turn[2], shift[2]), (count, 1))
    return Rays(
        np.sort(rng.uniform(0.0, 0.6, count)),
        np.zeros(count, dtype=np.int64),
        turn[:2] - plane[..., None] * turn[2],
        target,
        root,
        depth,
        0.04,
    )


def place(vectors: Array, times: Array, bounces: int, drag: Array, moment: float) -> Array:
    """(3,) m, the ball at a moment, flight by flight from the first bounce (or the anchor) on."""

    def moved(flight: int, since: float) -> Array:
        slower = max(drag[flight] * since, STRETCH_LIMIT)
        way = vectors[1 + flight] * (np.log1p(slower) / drag[flight] if drag[flight] else since)
        lift = vectors[2 + bounces + flight] if len(vectors) > bounces + 2 else np.zeros(3)
        return way + 0.5 * since**2 * (lift - np.array([0.0, 0.0, BALL.gravity]) / (1.0 + slower / 3.0))

    if not bounces or moment <= times[0]:
        return vectors[0] + moved(0, moment - times[0])
    at, flight = vectors[0].copy(), 1
    while flight < bounces and moment > times[flight]:
        at += moved(flight, times[flight] - times[flight - 1])
        flight += 1
    return at + moved(flight, moment - times[flight - 1])


def laws(scene: Scene, vectors: Array, times: Array, bounces: int, drag: Array) -> list[float]:
    """Whitened residuals of the priors, and of friction, restitution and the plane at each bounce."""
    centre, spread = place_prior(scene.surfaces)
    left = [*(vectors[0] - centre) / spread, *vectors[1 : bounces + 2].ravel() / SPEED]
    left += [*(vectors[bounces + 2 :] / (scene.lift or 1.0)).ravel()]
    for bounce in range(bounces):
        flown = times[bounce] - times[max(bounce - 1, 0)]
        slowed = 1.0 + drag[bounce] * flown
        before, after = vectors[1 + bounce] / slowed, vectors[2 + bounce]
        if bounce and scene.lift is not None:
            before = before + flown * vectors[bounces + 2 + bounce]
        fallen = before[2] - BALL.gravity * flown / (1.0 + drag[bounce] * flown / 2.0)
        left += [*(after[:2] - KEPT * before[:2]) / FRICTION_SIGMA]
        lean = np.array([scene.physics.slope_x, scene.physics.slope_y])
        rises = after[2] - lean @ after[:2] + BALL.restitution * (fallen - lean @ before[:2])
        at = place(vectors, times, bounces, drag, times[bounce])
        left += [rises / RESTITUTION_SIGMA, (at[2] - lean @ at[:2] - scene.plane) / PLANE_SIGMA]
    return left


def linear(residual: Callable[[Array], Array], size: int) -> tuple[Array, Array]:
    """The matrix (r, n) and the value at zero (r,) of linear residuals."""
    zero = residual(np.zeros(size))
    return np.stack([residual(row) - zero for row in np.eye(size)], axis=1), zero


@pytest.mark.parametrize("ball", [BALL, replace(BALL, slope_x=0.03, slope_y=-0.02)], ids=["level", "leaning"])
@pytest.mark.parametrize("lift", [None, LIFT])
@pytest.mark.parametrize("bounces", range(4))
def test_paths_are_those_of_least_squares(
    bounces: int, lift: tuple[float, float, float] | None, ball: SegmentationPhysics
) -> None:
    rng = np.random.default_rng([bounces, lift is None])
    seen = rays(rng, 12)
    scene = Scene(seen, ball, TABLE, 0.0, lift)
    times = np.sort(rng.uniform(0.1, 0.5, (3, max(bounces, 1))), axis=1)
    found = solved(scene, times, bounces)
    for k in range(3):
        count = bounces + 2 + (bounces + 1) * (lift is not None)
        depth, weight, drag = np.ones(12), np.ones(12), np.zeros(bounces + 1)
        for _ in range(ROUNDS):
            root = seen.root / np.sqrt(depth**2 + LAWS**2 * np.linalg.det(seen.root))[:, None, None]

            def path(unknown: Array, k: int = k, drag: Array = drag, count: int = count) -> Array:
                vectors = unknown.reshape(count, 3)
                return np.array([place(vectors, times[k], bounces, drag, float(t)) for t in seen.times])

            def rows(unknown: Array, root: Array = root, path: Callable[[Array], Array] = path) -> Array:
                off = np.einsum("nra,na->nr", seen.matrix, path(unknown)) - seen.target
                return np.einsum("nqr,nr->nq", root, off).ravel()

            def rules(unknown: Array, k: int = k, drag: Array = drag, count: int = count) -> Array:
                return np.array(laws(scene, unknown.reshape(count, 3), times[k], bounces, drag))

            (a, zero), (b, other) = linear(rows, 3 * count), linear(rules, 3 * count)
            some = np.repeat(np.sqrt(weight), 2)
            both = np.concatenate((a * some[:, None], b))
            unknown = -np.linalg.lstsq(both, np.concatenate((zero * some, other)))[0]
            square = ((a @ unknown + zero) ** 2).reshape(-1, 2).sum(axis=1)
            misfit = ROBUST**2 * np.log1p(square / ROBUST**2).sum() + ((b @ unknown + other) ** 2).sum()
            weight, vectors = 1.0 / (1.0 + square / ROBUST**2), unknown.reshape(count, 3)
            depth = np.maximum(np.einsum("na,na->n", seen.depth_row[:, :3], path(unknown)) + 9.0, NEAREST)
            drag = BALL.drag * np.minimum(np.linalg.norm(vectors[1 : bounces + 2], axis=1), 2.0 * SPEED)
        np.testing.assert_allclose(found.vectors[k], vectors, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(found.drag[k], drag, rtol=1e-6)
        assert found.misfit[k] == pytest.approx(misfit, rel=1e-7)
        covariance = np.linalg.inv(both.T @ both)
        np.testing.assert_allclose(found.covariance[k], covariance, rtol=1e-5, atol=1e-6 * covariance.max())
        prior = linear(
            lambda one, k=k, drag=drag: np.array(laws(scene, one.reshape(-1, 3), times[k], bounces, drag)), 3 * count
        )[0]
        left = 0.5 * (np.linalg.slogdet(prior.T @ prior)[1] + np.linalg.slogdet(covariance)[1])
        assert found.narrowed[k] == pytest.approx(left, abs=1e-5)
