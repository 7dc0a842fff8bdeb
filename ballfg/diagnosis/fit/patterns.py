"""Builds blocks of unnamed patterns: a force, a kick or a position error that depends on some quantities.

A block has one column for every quantity (centred, in units of its scatter over the data) along every axis. A further
block holds declared coefficients that change over a recording.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ballfg.arrays import Array, Mask
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.response import ArcResponse, weighted
from ballfg.diagnosis.fit.system import System
from ballfg.dynamics.effects.generic import flight_axes
from ballfg.state import POSITION, SPIN, VELOCITY

PLAUSIBLE = {"flight": 1.0, "contact": 0.2, "measurement": 0.01}
"""m/s^2, m/s and m: scatter of a pattern that is large in practice. Columns are responses to patterns of this size."""
Names = tuple[str, ...]
WORLD = ("along x", "along y", "vertically")
OWN = ("along the flight", "across the flight", "along the lift")
EVERYWHERE = "everywhere"  # The constant quantity
PLACE = ("place along x", "place along y", "height")
SPINS = ("spin about the flight", "topspin", "sidespin")

FLIGHT: tuple[tuple[Names, Names], ...] = (
    ((EVERYWHERE, *PLACE), WORLD),
    (("speed", "rate of climb"), OWN),
    (SPINS, OWN),
    (("time since launch", "time since the last contact"), OWN),
)
CONTACT: tuple[tuple[Names, Names], ...] = (
    ((EVERYWHERE, "vertical speed", "horizontal speed"), OWN),
    (PLACE[:2], WORLD),
    (SPINS, OWN),
)
MOTION = ("velocity along x", "velocity along y", "vertical velocity")
NEAR = ("nearness before a contact", "nearness after a contact")  # Of errors of position, if there are contacts
MEASUREMENT = (PLACE, MOTION)
"""Groups of quantities that are tested together; those of forces and kicks with the axes of the pattern."""
NEAR_FRAMES = 2.0  # Nearness falls by a factor of e in so many frames: trackers average over a few
DRIFT = "recording"  # Kind of the block of drift over a recording, as in reports
LEAST_SCATTER = 1e-6  # In the unit of a quantity. Smaller scatter is rounding: all tracks have the same value


@dataclass(frozen=True)
class Block:
    """p columns: f quantities along a axes (3 in space), axis by axis."""

    kind: str  # `flight`, `contact`, `measurement` or `recording`
    quantities: Names  # (f,) in words
    axes: Names  # (a,) in words
    values: Array  # (m, f) of the quantities where the pattern acts
    columns: Array  # (n, 3 k + 3, a f) whitened responses of the samples


def blocks_of(fit: Fit) -> list[Block]:
    """All blocks of a fit; those of contacts only if there are contacts."""
    after = [arc for arc in fit.arcs if arc.number]
    blocks = [_flight(fit, fit.arcs, group, axes) for group, axes in FLIGHT]
    if after:
        blocks += [_contact(fit, after, group, axes) for group, axes in CONTACT]
    return blocks + _measurement(fit, (*MEASUREMENT, NEAR) if after else MEASUREMENT)


def _flight(fit: Fit, arcs: list[ArcResponse], group: Names, axes: Names) -> Block:
    found = [_chosen(group, _quantities(a.nodes, a.times, a.times - a.begun[:, None])) for a in arcs]

    def moved(arc: ArcResponse, values: Array) -> Array:
        return arc.response_to(_spread(_axes(axes, arc.nodes), values))

    return _over_arcs("flight", fit, arcs, found, group, axes, moved)


def _contact(fit: Fit, arcs: list[ArcResponse], group: Names, axes: Names) -> Block:
    found = [_chosen(group, _quantities(a.incoming, a.begun, np.zeros_like(a.begun))) for a in arcs]

    def moved(arc: ArcResponse, values: Array) -> Array:
        above = arc.incoming.copy()  # the flight seen from above: forward, across, up
        above[..., VELOCITY.stop - 1] = 0.0
        return np.asarray(arc.kicks[..., :3] @ _spread(_axes(axes, above), values)[:, None])

    return _over_arcs("contact", fit, arcs, found, group, axes, moved)


def _over_arcs(
    kind: str,
    fit: Fit,
    arcs: list[ArcResponse],
    found: list[Array],
    group: Names,
    axes: Names,
    moved: Callable[[ArcResponse, Array], Array],
) -> Block:
    """A block of patterns in arcs; found: the quantities in each; moved: responses of an arc to scaled quantities."""
    values = np.concatenate([f.reshape(-1, len(group)) for f in found])
    scale = _Scale.of(group, values)
    columns: Array | None = None
    for arc, own in zip(arcs, found, strict=True):
        rows = weighted(fit, PLAUSIBLE[kind] * moved(arc, scale(own)), arc.rows)
        columns = np.zeros((len(fit.problem.stretches), *rows.shape[1:])) if columns is None else columns
        columns[arc.rows] += rows
    assert columns is not None
    return Block(kind, group, axes, scale(values), columns)


def _measurement(fit: Fit, groups: Sequence[Names]) -> list[Block]:
    used, path, times = fit.problem.stretches.used.numpy(), fit.path, fit.path.times.T.numpy()
    quantities = _quantities(path.states, times, np.zeros_like(times)) | _nearness(times, used, path.motion.contacts)
    blocks, axes = [], _axes(WORLD, path.states)
    for group in groups:
        found = _chosen(group, quantities)
        scale = _Scale.of(group, found[used])
        columns = weighted(fit, PLAUSIBLE["measurement"] * _spread(axes, scale(found)), np.arange(len(used)))
        blocks.append(Block("measurement", group, WORLD, scale(found[used]), columns))
    return blocks


def _quantities(states: Array, times: Array, since: Array) -> dict[str, Array]:
    """All quantities at states (..., 9), times since launch and since the last contact or launch (...,) s."""
    velocity, spin = states[..., VELOCITY], states[..., SPIN]
    about = (flight_axes(torch.from_numpy(velocity)).numpy() @ spin[..., None])[..., 0]
    vectors = {PLACE: states[..., POSITION], MOTION: velocity, SPINS: about}
    return {
        EVERYWHERE: np.ones_like(times),
        **{name: vector[..., i] for names, vector in vectors.items() for i, name in enumerate(names)},
        "speed": np.linalg.norm(velocity, axis=-1),
        "horizontal speed": np.linalg.norm(velocity[..., :2], axis=-1),
        "vertical speed": -velocity[..., 2],
        "rate of climb": velocity[..., 2],
        "time since launch": times,
        "time since the last contact": since,
    }


def _nearness(times: Array, used: Mask, contacts: torch.Tensor) -> dict[str, Array]:
    """Quantities NEAR at samples (n, k), of which some are used: 1 at a contact (n, c), fading with the time from it.

    An average over frames, a hidden ball and a late detection all displace positions there and nowhere else.
    """
    steps = np.diff(times, axis=1)[used[:, 1:]]
    fading = NEAR_FRAMES * float(np.median(steps))
    ways = since_contact(-times, -contacts.numpy()), since_contact(times, contacts.numpy())
    return {name: np.nan_to_num(np.exp(-way / fading)) for name, way in zip(NEAR, ways, strict=True)}


def since_contact(times: Array, contacts: Array) -> Array:
    """(n, k) s since the last contact (n, c) before times (n, k), NaN before the first one."""
    after = times[..., None] - contacts[:, None, :]
    after = np.where(after >= 0.0, after, np.inf)
    least = after.min(axis=-1, initial=np.inf)
    return np.where(np.isfinite(least), least, np.nan)


def _chosen(group: Names, found: Mapping[str, Array]) -> Array:
    """(..., f) quantities of a group."""
    return np.stack([found[name] for name in group], axis=-1)


@dataclass(frozen=True)
class _Scale:
    """Centre and scatter (f,) of quantities over all places where a pattern acts."""

    centre: Array
    scatter: Array

    @staticmethod
    def of(group: Names, values: Array) -> "_Scale":
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


def _axes(names: Names, states: Array) -> Array:
    """(..., 3, 3) rows: the axes at states (..., 9)."""
    if names == WORLD:
        return np.broadcast_to(np.eye(3), (*states.shape[:-1], 3, 3))
    return flight_axes(torch.from_numpy(states[..., VELOCITY])).numpy()


def drift_block(fit: Fit, system: System) -> Block | None:
    """One column for each free coefficient: one prior sigma below its value at the first track, one above at the last.

    It tests for another table, ball or day. None without free coefficients, or with one track only.

    Args: system: of the fit, linearised at its minimum.
    """
    free = {name: c for name, c in fit.problem.free.items() if name not in fit.problem.deviations}
    number = fit.problem.stretches.track.astype(np.float64)
    if not free or np.ptp(number) == 0.0:
        return None
    order = 2.0 * (number - number.min()) / np.ptp(number) - 1.0
    sigmas = np.array([c.sigma for c in free.values()])
    chosen = [place for place, name in enumerate(fit.problem.free) if name in free]
    columns = order[:, None, None] * system.by_common[..., chosen] * sigmas
    return Block(DRIFT, quantities=tuple(free), axes=("",), values=np.eye(len(free)), columns=columns)


def describe_drift(fit: Fit, block: Block, strengths: Array) -> str:
    """The coefficient with the largest change and its values, in words; strengths: (1, f) of the block's columns."""
    most = int(np.argmax(np.abs(strengths[0])))
    name, coefficient = block.quantities[most], fit.problem.free[block.quantities[most]]
    change = np.array((-1.0, 1.0)) * strengths[0, most] * coefficient.sigma
    first, last = np.clip(fit.unknowns.values[name] + change, coefficient.low, coefficient.high)
    unit = "" if coefficient.unit == "1" else f" {coefficient.unit}"
    return f"recording: {name} changes from {first:.3g} to {last:.3g}{unit} between the first tracks and the last"
