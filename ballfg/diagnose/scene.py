"""What a set of tracks spans: where the balls flew, how fast, how high; and the shapes that effects may have there."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ballfg.diagnose.fit import Fit
from ballfg.dynamics.effect import Effect
from ballfg.state import VELOCITY

Array = NDArray[np.float64]

PLACES = {"x": 4, "y": 2, "z": 2}
"""Centres of a region that are tried along each axis."""
REGION_SHARE = 0.25
"""Size of a region that is tried, as a share of the longest extent of the tracks."""


@dataclass(frozen=True)
class Scene:
    """Extent of the data.

    Attributes:
        low, high, middle: (3,) m, of the positions.
        speed: m/s, median over samples.  impact_speed: m/s, median normal speed of impacts; NaN without contacts.
        contacts, labels: how many there are.
    """

    low: Array
    high: Array
    middle: Array
    speed: float
    impact_speed: float
    contacts: int
    labels: int


def scene_of(fit: Fit) -> Scene:
    """What the stretches of a fit span."""
    stretches = fit.problem.stretches
    used = stretches.used.numpy()
    positions = stretches.positions.numpy()[used]
    times = stretches.times.numpy()
    velocities = np.gradient(fit.predicted.positions, axis=1) / np.maximum(np.gradient(times, axis=1), 1e-4)[..., None]
    speed = float(np.median(np.linalg.norm(velocities[used], axis=-1)))
    contacts = fit.predicted.contacts
    impacts = [
        -velocities[i, max(0, int(np.searchsorted(times[i], time)) - 2), VELOCITY.stop - VELOCITY.start - 1]
        for i, row in enumerate(contacts)
        for time in row[np.isfinite(row)]
    ]
    return Scene(
        positions.min(axis=0),
        positions.max(axis=0),
        np.median(positions, axis=0),
        speed,
        float(np.median(impacts)) if impacts else float("nan"),
        len(impacts),
        int((~np.isnan(stretches.labels[:, 0].numpy())).sum()),
    )


def shapes_of(effect: type[Effect], scene: Scene) -> Sequence[Mapping[str, float]]:
    """The shapes in which an effect is looked for: values of its coefficients that only give it a form.

    A reference is the middle of what the data span, a region is tried at places over their extent.
    """
    names = [c.name for c in effect.coefficients if c.absent is None]
    if not names:
        return ({},)
    if "size" in names:
        return _regions(scene)
    reference = {"drag_speed": scene.speed, "restitution_speed": scene.impact_speed, "wind_shear": scene.middle[2]}
    if names == ["reference"] and effect.name in reference:
        return ({"reference": float(reference[effect.name])},)
    return ({},)


def _regions(scene: Scene) -> list[dict[str, float]]:
    extent = scene.high - scene.low
    axes = [scene.low[a] + extent[a] * (np.arange(n) + 0.5) / n for a, n in enumerate(PLACES.values())]
    size = REGION_SHARE * float(extent.max())
    return [
        {"center_x": float(x), "center_y": float(y), "center_z": float(z), "size": size}
        for x, y, z in itertools.product(*axes)
    ]
