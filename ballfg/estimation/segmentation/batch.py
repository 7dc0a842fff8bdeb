"""Segments a whole track by a forward pass over all samples and a second look at its contacts."""

import numpy as np
from numpy.typing import ArrayLike

from ballfg.arrays import Array
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.segmentation.assembly import BREAKS, contacts_of, intervals_of, quality_of, rests_of
from ballfg.estimation.segmentation.events import EventKind
from ballfg.estimation.segmentation.physics import SegmentationPhysics
from ballfg.estimation.segmentation.result import Quality, Segmentation
from ballfg.estimation.segmentation.second_look import hits_at_contacts
from ballfg.estimation.segmentation.segmenter import Segmenter
from ballfg.estimation.segmentation.settings import SegmentationSettings


def segment(
    times: ArrayLike,
    positions: ArrayLike,
    sigma: ArrayLike,
    *,
    surfaces: Surfaces,
    physics: SegmentationPhysics | None = None,
    settings: SegmentationSettings | None = None,
) -> Segmentation:
    """Finds contacts, hits, rests and bad samples of one track.

    Args:
        times: (n,) s, strictly increasing.
        positions: (n, 3) m, world frame, z up.
        sigma: (3,) or (n, 3) m, standard deviation of each coordinate. Half the true noise makes false shifts.
            `estimate_position_noise` estimates it from the data.
        surfaces: table and floor; the ball's centre bounces a radius and the physics' offset above them.
        physics: of the ball, see `physics_of`; None: table tennis.
        settings: noise model and prices of events; None: defaults.
    Returns: the best explanation; n = 0 gives an empty one.
    Raises: ValueError: if shapes disagree, something is not finite, or times do not increase.
    Source: docs/derivations/segmentation.md.
    """
    t, x, s = _checked(times, positions, sigma)
    physics, settings = physics or SegmentationPhysics(), settings or SegmentationSettings()
    events = Segmenter(surfaces, physics, settings).push_all(t, x, s)
    contacts, hits = contacts_of(events), intervals_of(events, *BREAKS)
    quality = quality_of(events, len(t), settings.shift_level)
    hits += hits_at_contacts(t, x, quality <= Quality.WIDE, contacts, hits, physics, settings)
    return Segmentation(
        contacts=tuple(contacts),
        hits=np.array(sorted(hits), dtype=np.int64),
        restarts=np.array(intervals_of(events, EventKind.RESTART), dtype=np.int64),
        rests=tuple(rests_of(events, len(t))),
        quality=quality,
    )


def _checked(times: ArrayLike, positions: ArrayLike, sigma: ArrayLike) -> tuple[Array, Array, Array]:
    t = np.asarray(times, dtype=np.float64)
    x = np.asarray(positions, dtype=np.float64)
    s = np.asarray(sigma, dtype=np.float64)
    if t.ndim != 1 or x.shape != (len(t), 3):
        raise ValueError(
            f"times must be (n,) and positions (n, 3); got {t.shape} and {x.shape}. Pass one row a sample."
        )
    if s.shape not in ((3,), x.shape):
        raise ValueError(f"sigma must be (3,) or {x.shape}; got {s.shape}. Give one standard deviation a coordinate.")
    if not (s > 0).all():
        raise ValueError(f"sigma must be positive; got {s.min():g}. Use estimate_position_noise where none is known.")
    good = np.isfinite(t) & (np.diff(t, prepend=-np.inf) > 0.0)
    if not good.all():
        raise ValueError(f"times must be finite and increase; got {t[~good][0]} s. Sort the samples.")
    for name, array in (("positions", x), ("sigma", s)):
        if not np.isfinite(array).all():
            wrong = array[~np.isfinite(array)][0]
            raise ValueError(f"{name} must be finite numbers in m; got {wrong}. Drop samples without a position.")
    return t, x, np.broadcast_to(s, x.shape)
