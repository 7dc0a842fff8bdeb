"""Settings for a dataset: what it says about its noise, and where it says nothing, what its tracks show."""

from __future__ import annotations

from itertools import islice

from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimate.position_noise import estimate_position_noise
from ballfg.estimate.settings import Settings, uncertain
from ballfg.tracks import Dataset

TRACKS_FOR_NOISE = 50
"""How many tracks the measurement noise is estimated from, when a dataset does not state it."""


def dataset_settings(dataset: Dataset, model: BallModel) -> Settings:
    """Settings for measured tracks.

    The position noise is the dataset's; where it states none, it is estimated from the scatter of the first tracks
    about short polynomials. The model's coefficients are estimated with each track, within their priors.
    """
    info = dataset.info
    if info.position_noise is not None:
        noise = (info.position_noise,) * 3
    else:
        x, y, z = estimate_position_noise(islice(iter(dataset), TRACKS_FOR_NOISE)).tolist()
        noise = (x, y, z)
    spin = {} if info.spin_noise is None else {"spin_label_noise": info.spin_noise}
    return uncertain(model, position_noise=noise, **spin)


def dataset_surfaces(dataset: Dataset) -> Surfaces:
    """The dataset's table, of unknown extent, and the floor below it."""
    return Surfaces.table_tennis(dataset.info.table_height)
