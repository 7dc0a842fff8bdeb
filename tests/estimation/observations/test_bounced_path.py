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
    SLOWEST,
    SPEED,
    STRETCH_LIMIT,
)
from ballfg.estimation.observations.bounced_path import LIFT, Scene, place_prior, solved
from ballfg.estimation.observations.ray_path import NEAREST, ROBUST, ROUNDS, Rays
from ballfg.estimation.segmentation.physics import SegmentationPhysics

TABLE = Surfaces(0.0, -0.76, (-1.37, 1.37, -0.7625, 0.7625))
BALL = SegmentationPhysics()
TURN, SHIFT = (
    np.array([[1.0, 0.0, 0.0], [0.0, 0.4, -np.sqrt(0.84)], [0.0, np.sqrt(0.84), 0.4]]),
    np.array([0.0, 0.0, 9.0]),
)
"""Of a camera 9 m beside the table."""


def rays_of(times: Array, places: Array, root: Array, noise: Array | float = 0.0) -> Rays:
    """Rays through places (n, 3) m; root: (n, 2, 2) of the information of normalized pixels, noise: (n, 2) of these."""
    at = places @ TURN.T + SHIFT
    plane = at[:, :2] / at[:, 2:] + noise
    target, depth = plane * SHIFT[2] - SHIFT[:2], np.tile(np.append(TURN[2], SHIFT[2]), (len(times), 1))
    matrix = TURN[:2] - plane[..., None] * TURN[2]
    return Rays(times, np.zeros(len(times), dtype=np.int64), matrix, target, root, depth, 0.04)


def rays(rng: np.random.Generator, count: int) -> Rays:
    """Rays through places about the table, with a noise of about a pixel of 1000."""
    places, noise = rng.uniform((-1.5, -0.5, 0.05), (1.5, 0.5, 0.6), (count, 3)), rng.normal(0.0, 1e-3, (count, 2))
    root = 1e3 * (np.eye(2) + 0.2 * rng.normal(size=(count, 2, 2)))
    return rays_of(np.sort(rng.uniform(0.0, 0.6, count)), places, root, noise)


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


def laws(scene: Scene, vectors: Array, times: Array, bounces: int, drag: Array, speed: Array) -> list[float]:
    """Whitened residuals of the priors, and of friction, restitution and the plane at each bounce."""
    centre, spread = place_prior(scene.surfaces)
    left = [*(vectors[0] - centre) / spread, *vectors[1 : bounces + 2].ravel() / SPEED]
    if scene.lift is not None:  # spin carries a fast ball more than a slow one
        left += [*(vectors[bounces + 2 :] / np.outer(np.maximum(speed, SLOWEST), scene.lift)).ravel()]
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
    given = rays(rng, 12)
    scene = Scene(given, ball, TABLE, 0.0, lift)
    times = np.sort(rng.uniform(0.1, 0.5, (3, max(bounces, 1))), axis=1)
    found = solved(scene, times, bounces)
    for k in range(3):
        count = bounces + 2 + (bounces + 1) * (lift is not None)
        depth, weight, drag = np.ones(12), np.ones(12), np.zeros(bounces + 1)
        flown = np.full(bounces + 1, SPEED)
        for _ in range(ROUNDS):
            speed = flown
            root = given.root / np.sqrt(depth**2 + LAWS**2 * np.linalg.det(given.root))[:, None, None]

            def path(unknown: Array, k: int = k, drag: Array = drag, count: int = count) -> Array:
                vectors = unknown.reshape(count, 3)
                return np.array([place(vectors, times[k], bounces, drag, float(t)) for t in given.times])

            def rows(unknown: Array, root: Array = root, path: Callable[[Array], Array] = path) -> Array:
                off = np.einsum("nra,na->nr", given.matrix, path(unknown)) - given.target
                return np.einsum("nqr,nr->nq", root, off).ravel()

            def rules(
                unknown: Array, k: int = k, drag: Array = drag, count: int = count, speed: Array = speed
            ) -> Array:
                return np.array(laws(scene, unknown.reshape(count, 3), times[k], bounces, drag, speed))

            (a, zero), (b, other) = linear(rows, 3 * count), linear(rules, 3 * count)
            some = np.repeat(np.sqrt(weight), 2)
            both = np.concatenate((a * some[:, None], b))
            unknown = -np.linalg.lstsq(both, np.concatenate((zero * some, other)))[0]
            square = ((a @ unknown + zero) ** 2).reshape(-1, 2).sum(axis=1)
            misfit = ROBUST**2 * np.log1p(square / ROBUST**2).sum() + ((b @ unknown + other) ** 2).sum()
            weight, vectors = 1.0 / (1.0 + square / ROBUST**2), unknown.reshape(count, 3)
            depth = np.maximum(np.einsum("na,na->n", given.depth_row[:, :3], path(unknown)) + 9.0, NEAREST)
            flown = np.minimum(np.linalg.norm(vectors[1 : bounces + 2], axis=1), 2.0 * SPEED)
            drag = BALL.drag * flown
        np.testing.assert_allclose(found.vectors[k], vectors, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(found.drag[k], drag, rtol=1e-6)
        assert found.misfit[k] == pytest.approx(misfit, rel=1e-7)
        covariance = np.linalg.inv(both.T @ both)
        np.testing.assert_allclose(found.covariance[k], covariance, rtol=1e-5, atol=1e-6 * covariance.max())
        prior = linear(
            lambda one, k=k, drag=drag, speed=speed: np.array(
                laws(scene, one.reshape(-1, 3), times[k], bounces, drag, speed)
            ),
            3 * count,
        )[0]
        left = 0.5 * (np.linalg.slogdet(prior.T @ prior)[1] + np.linalg.slogdet(covariance)[1])
        assert found.narrowed[k] == pytest.approx(left, abs=1e-5)


def moving(velocity: tuple[float, float, float], fall: float) -> Rays:
    """Rays of a ball that moves so, m/s, 0.3 m above the table's middle, and falls, m/s^2, to a pixel of 1000."""
    since = np.arange(-6.0, 6.0) * 0.05
    places = np.array([0.0, 0.0, 0.3]) + np.outer(since, velocity) - np.outer(0.5 * fall * since**2, [0.0, 0.0, 1.0])
    return rays_of(since, places, np.tile(1e3 * np.eye(2), (12, 1, 1)))


def test_spin_carries_no_slow_flight() -> None:
    """A shoe that goes on steadily at 0.4 m/s is no ball near the lens whose spin carries it; a fast ball has lift."""
    anchor = np.array([[0.0]])
    shoe = solved(Scene(moving((0.4, 0.1, 0.0), 0.0), BALL, TABLE, 0.0, LIFT), anchor, 0)
    assert shoe.misfit[0] > 10.0 * 12
    ball = solved(Scene(moving((8.0, 0.1, 0.5), 5.8), BALL, TABLE, 0.0, LIFT), anchor, 0)
    assert ball.misfit[0] < 2.0 * 12
    assert ball.vectors[0, 2, 2] == pytest.approx(4.0, abs=1.5)
