"""One camera that is known roughly: its file is wrong, and clicks on the table's corners correct it."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics import nominal_model
from ballfg.estimation import sighted_track
from ballfg.estimation.observations.sighted_dataset import SightedDataset
from ballfg.estimation.observations.sightings import sightings_of
from ballfg.tracks import Track
from ballfg.vision.calibration.focal import pose_and_focal
from ballfg.vision.calibration.table_points import Marked
from ballfg.vision.camera_change import changed

FOCAL: Final = 0.05
"""Relative error of the focal length, up or down."""
TURN, MOVE = np.deg2rad(2.0), 0.1
"""rad and m, errors of the pose, in any direction."""
CLICK: Final = 3.0
"""px, noise of each coordinate of a corner."""


def roughly_known(view: SightedDataset, tracks: list[Track], seed: int) -> Iterator[Track]:
    """The tracks of a view as a camera sees them that corners of the table gave back.

    Args: view: of one camera, with the ends of its table.  seed: of the camera's errors and of the clicks.
    Raises: ValueError: a view without the table's ends.
    """
    if view.info.table_extent is None:
        raise ValueError(f"{view.path} must state the table's ends, frame.table; it does not. Add them.")
    low_x, high_x, low_y, high_y = view.info.table_extent
    height, (camera,), rng = view.info.table_height, view.cameras, np.random.default_rng(seed)
    corners = np.array([(x, y, height) for x in (low_x, high_x) for y in (low_y, high_y)])
    clicks = camera.project(corners) + CLICK * rng.standard_normal((4, 2))
    zoom = np.log1p(rng.choice((-FOCAL, FOCAL)))
    wrong = changed(camera, np.concatenate((TURN * _direction(rng), MOVE * _direction(rng), [zoom])))
    found = pose_and_focal(wrong, Marked(("a", "b", "c", "d"), corners, clicks, CLICK), FOCAL).camera
    model = nominal_model(view.ball)
    for track in tracks:
        sightings = sightings_of(track).sightings
        again = sighted_track(track.name, sightings, [found], track.labels, model=model)
        yield replace(again, dataset=view)


def _direction(rng: np.random.Generator) -> Array:
    """(3,) a unit vector."""
    drawn = rng.standard_normal(3)
    return np.asarray(drawn / np.linalg.norm(drawn))
