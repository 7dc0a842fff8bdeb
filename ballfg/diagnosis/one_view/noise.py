"""Chooses how far the strokes of one camera scatter about the laws: the less they do, the smaller an effect they show.

The usual noise of such tracks is that of measured strokes. A share of it is chosen with which the sightings are most
probable, the states integrated out in Laplace's approximation.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from ballfg.diagnosis.one_view.strokes import Laws, parts_of
from ballfg.estimation import Settings
from ballfg.estimation.batch import do_all
from ballfg.state import STATE_DIM
from ballfg.tracks.track import Track

SHARES: Final = (1.0, 0.5, 0.25, 0.125, 0.0625)
SCALED: Final = ("acceleration", "spin", "contact_velocity", "contact_tangential", "contact_spin")


def with_share(settings: Settings, share: float) -> Settings:
    """Settings with a share of the noise of flights and bounces of one camera's tracks."""
    process = replace(settings.process, **{name: share * getattr(settings.process, name) for name in SCALED})
    return replace(settings, process=process, one_view_acceleration=share * settings.one_view_acceleration)


def share_of(settings: Settings) -> float:
    """The share of the usual noise that settings have."""
    return settings.one_view_acceleration / Settings.one_view_acceleration


def with_likeliest_noise(laws: Laws, tracks: Sequence[Track], jobs: int) -> Laws:
    """The laws with the share of their settings' noise that makes the sightings of tracks most probable."""
    offered = [replace(laws, settings=with_share(laws.settings, share)) for share in SHARES]
    found = do_all([partial(_densities, one, part) for one in offered for part in parts_of(tracks)], jobs)
    densities = np.concatenate(found).reshape(len(SHARES), len(tracks))
    densities += -np.log(SHARES)[:, None] * [[STATE_DIM * (len(track) - 1) for track in tracks]]
    known = np.isfinite(densities).all(axis=0)
    return offered[int(np.argmax(densities[:, known].sum(axis=1)))]


def _densities(laws: Laws, tracks: Sequence[Track]) -> list[float]:
    """Logarithm of the density of each track's sightings, but for that of the noise's size; NaN without a minimum."""
    smoother, found = laws.smoother, list[float]()
    for filmed in tracks:
        track = smoother.prepared(laws.picture.seen_by(filmed, laws.model, laws.surfaces))
        problem, solution = smoother.solved(track.since_first())
        step, error = solution.minimum.step, smoother.result(problem, solution).error
        found.append(float("nan") if step is None else -error - step.root.log_determinant)
    return found
