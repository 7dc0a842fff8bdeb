"""Patterns that need no name: a force, a kick or an error of position that depends on one group of quantities.

A block is such a group: every quantity (centred, in units of its scatter over the data) along every axis, as columns of
what it would do to the samples. Which quantity along which axis is kept in words.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.response import Along, ArcResponse, along, responses, weighted
from ballfg.dynamics.effects.generic import flight_axes
from ballfg.state import POSITION, SPIN, VELOCITY

PLAUSIBLE = {"flight": 1.0, "contact": 0.2, "measurement": 0.01}
"""m/s^2, m/s and m: scatter of a pattern that is large in practice. Columns are answers to patterns of this size."""
UNIT = {"flight": "m/s^2", "contact": "m/s", "measurement": "m"}
WORLD = ("along x", "along y", "vertically")
OWN = ("along the flight", "across the flight", "along the lift")
EVERYWHERE = "everywhere"
"""The quantity that is one for all."""
PLACE = ("place along x", "place along y", "height")
SPINS = ("spin about the flight", "topspin", "sidespin")

FLIGHT = (
    ((EVERYWHERE, *PLACE), WORLD),
    (("speed", "rate of climb"), OWN),
    (SPINS, OWN),
    (("time since launch", "time since the last contact"), OWN),
)
CONTACT = (((EVERYWHERE, "vertical speed", "horizontal speed"), OWN), (PLACE[:2], WORLD), (SPINS, OWN))
MEASUREMENT = (PLACE, ("velocity along x", "velocity along y", "vertical velocity"))
"""Groups of quantities that are tested together; those of forces and kicks with the axes of the pattern."""
LEAST_SCATTER = 1e-6
"""In the unit of a quantity. Less is rounding: all tracks have the same of it."""

Array = NDArray[np.float64]
Quantities = Mapping[str, Array]
"""(...,) values by name in words."""


@dataclass(frozen=True)
class Block:
    """p columns: f quantities along a axes (3 in space), axis by axis.

    Attributes:
        kind: `flight`, `contact`, `measurement` or `recording`.
        quantities: (f,) in words.  axes: (a,) in words.
        values: (m, f) of the quantities at the places where the pattern acts.
        columns: (n, 3 k + 3, a f) whitened answers of the samples.
    """

    kind: str
    quantities: tuple[str, ...]
    axes: tuple[str, ...]
    values: Array
    columns: Array


def blocks_of(fit: Fit) -> list[Block]:
    """All blocks of a fit; those of contacts only where there are contacts."""
    path = along(fit)
    arcs = list(responses(fit, path))
    after = [arc for arc in arcs if arc.number]
    blocks = [_flight(fit, arcs, group, axes) for group, axes in FLIGHT]
    if after:
        blocks += [_contact(fit, after, group, axes) for group, axes in CONTACT]
    return blocks + [_measurement(fit, path, group) for group in MEASUREMENT]


def _quantities(states: Array, times: Array, since: Array) -> dict[str, Array]:
    """All of them at states (..., 9), times since launch and since the last contact or launch (...,) s."""
    velocity, spin = states[..., VELOCITY], states[..., SPIN]
    about = (flight_axes(torch.from_numpy(velocity)).numpy() @ spin[..., None])[..., 0]
    place, velocities = dict(zip(PLACE, np.moveaxis(states[..., POSITION], -1, 0), strict=True)), MEASUREMENT[1]
    return {
        EVERYWHERE: np.ones_like(times),
        **place,
        **dict(zip(velocities, np.moveaxis(velocity, -1, 0), strict=True)),
        **dict(zip(SPINS, np.moveaxis(about, -1, 0), strict=True)),
        "speed": np.linalg.norm(velocity, axis=-1),
        "horizontal speed": np.linalg.norm(velocity[..., :2], axis=-1),
        "vertical speed": -velocity[..., 2],
        "rate of climb": velocity[..., 2],
        "time since launch": times,
        "time since the last contact": since,
    }


def _chosen(group: tuple[str, ...], found: Quantities) -> Array:
    """(..., f) quantities of a group."""
    return np.stack([found[name] for name in group], axis=-1)


@dataclass(frozen=True)
class _Scale:
    """Centre and scatter (f,) of quantities over all places where a pattern acts."""

    centre: Array
    scatter: Array

    @staticmethod
    def of(group: tuple[str, ...], values: Array) -> _Scale:
        flat = values.reshape(-1, values.shape[-1])
        same = np.array([name == EVERYWHERE for name in group])
        scatter = np.where(same, 1.0, flat.std(axis=0))
        return _Scale(np.where(same, 0.0, flat.mean(axis=0)), np.where(scatter > LEAST_SCATTER, scatter, np.inf))

    def __call__(self, values: Array) -> Array:
        return np.asarray((values - self.centre) / self.scatter)


def _spread(axes: Array, values: Array) -> Array:
    """(..., 3, 3 f) vectors: every value (..., f) along every axis, rows of (..., 3, 3)."""
    product = np.swapaxes(axes, -1, -2)[..., :, :, None] * values[..., None, None, :]
    return product.reshape(*product.shape[:-2], -1)


def _axes(names: tuple[str, str, str], states: Array) -> Array:
    """(..., 3, 3) rows: the axes at states (..., 9)."""
    if names == WORLD:
        return np.broadcast_to(np.eye(3), (*states.shape[:-1], 3, 3))
    return flight_axes(torch.from_numpy(states[..., VELOCITY])).numpy()


def _flight(fit: Fit, arcs: list[ArcResponse], group: tuple[str, ...], axes: tuple[str, str, str]) -> Block:
    found = [_chosen(group, _quantities(a.nodes, a.times, a.times - a.begun[:, None])) for a in arcs]
    values = np.concatenate([f.reshape(-1, len(group)) for f in found])
    scale = _Scale.of(group, values)
    answers = (
        (a, PLAUSIBLE["flight"] * a.answer(_spread(_axes(axes, a.nodes), scale(f))))
        for a, f in zip(arcs, found, strict=True)
    )
    return Block("flight", group, axes, scale(values), _summed(fit, answers))


def _contact(fit: Fit, arcs: list[ArcResponse], group: tuple[str, ...], axes: tuple[str, str, str]) -> Block:
    found = [_chosen(group, _quantities(a.incoming, a.begun, np.zeros_like(a.begun))) for a in arcs]
    values = np.concatenate(found)
    scale = _Scale.of(group, values)
    answers = (
        (a, PLAUSIBLE["contact"] * (a.kicks[..., :3] @ _spread(_level(axes, a.incoming), scale(f))[:, None]))
        for a, f in zip(arcs, found, strict=True)
    )
    return Block("contact", group, axes, scale(values), _summed(fit, answers))


def _level(names: tuple[str, str, str], states: Array) -> Array:
    """As `_axes`, with the flight seen from above: forward, across, up."""
    above = states.copy()
    above[..., VELOCITY.stop - 1] = 0.0
    return _axes(names, above)


def _measurement(fit: Fit, path: Along, group: tuple[str, ...]) -> Block:
    used = fit.problem.stretches.used.numpy()
    found = _chosen(group, _quantities(path.states, path.times.T.numpy(), np.zeros_like(path.times.T.numpy())))
    scale = _Scale.of(group, found[used])
    moved = PLAUSIBLE["measurement"] * _spread(_axes(WORLD, path.states), scale(found))
    return Block("measurement", group, WORLD, scale(found[used]), weighted(fit, moved, np.arange(len(used))))


def _summed(fit: Fit, answers: Iterator[tuple[ArcResponse, Array]]) -> Array:
    """(n, 3 k + 3, p) whitened answers, summed over the arcs of each stretch."""
    total: Array | None = None
    for arc, moved in answers:
        rows = weighted(fit, moved, arc.rows)
        if total is None:
            total = np.zeros((len(fit.problem.stretches), *rows.shape[1:]))
        total[arc.rows] += rows
    assert total is not None
    return total
