"""The scene that the stretches of a fit span."""

from __future__ import annotations

import numpy as np

from ballfg.diagnosis.fit.problem import Fit
from ballfg.dynamics.scene import Scene, Vector

LEAST_GAP = 1e-4
"""s. Stamps nearer together tell no speed."""


def scene_of(fit: Fit) -> Scene:
    """What the stretches of a fit span."""
    stretches = fit.problem.stretches
    used = stretches.used.numpy()
    positions, times = stretches.positions.numpy()[used], stretches.times.numpy()
    gaps = np.maximum(np.gradient(times, axis=1), LEAST_GAP)[..., None]
    velocities = np.gradient(fit.predicted.positions, axis=1) / gaps
    impacts = [
        -velocities[i, max(0, int(np.searchsorted(times[i], time)) - 2), 2]  # no difference spans the contact there
        for i, row in enumerate(fit.predicted.contacts)
        for time in row[np.isfinite(row)]
    ]
    return Scene(
        _vector(positions.min(axis=0)),
        _vector(positions.max(axis=0)),
        _vector(np.median(positions, axis=0)),
        float(np.median(np.linalg.norm(velocities[used], axis=-1))),
        float(np.median(impacts)) if impacts else float("nan"),
        len(impacts),
        int(stretches.labelled.sum()),
    )


def _vector(values: np.ndarray) -> Vector:
    x, y, z = values.tolist()
    return x, y, z
