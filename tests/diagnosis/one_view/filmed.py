"""Strokes that one camera films, with errors of its clock and lens, by laws with or without a planted effect."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from ballfg.benchmarks.cameras.strokes import MODEL, SURFACES, TABLE, flown, scattered, stroke
from ballfg.diagnosis.one_view.picture import Picture
from ballfg.dynamics import AnalyticModel
from ballfg.estimation.observations.sightings import sighted_track, sightings_of
from ballfg.state import POSITION
from ballfg.tracks import Track
from ballfg.tracks.info import TABLE_TENNIS, DatasetInfo, write_info
from ballfg.tracks.sightings import Sightings
from ballfg.vision.camera_file import write_cameras
from tests.estimation.observations.sighted_rig import looking
from tests.written_tables import write_sightings

CAMERA: Final = looking("side", (-0.2, -4.0, 2.2))
RATE, NOISE = 50.0, 1.0  # Hz, px


def strokes(
    count: int,
    seed: int,
    truth: AnalyticModel = MODEL,
    picture: Picture | None = None,
    noise: float = NOISE,
    *,
    scatter: bool = False,
) -> list[Track]:
    """Tracks of strokes from either side, filmed by a camera with some errors that nobody declares.

    Args: scatter: flights, bounces and spins are those of the population that the intervals of strokes are for.
    """
    rng, found, errors = np.random.default_rng(seed), list[Track](), picture or Picture()
    camera = errors.camera(CAMERA)
    while len(found) < count:
        side = float(rng.choice([-1, 1]))
        place = np.array([side * rng.uniform(1.2, 1.5), rng.uniform(-0.4, 0.4), TABLE + rng.uniform(0.1, 0.35)])
        if (drawn := _drawn(place, -side, rng, truth, scatter)) is not None:
            lasts, at = drawn
            times = np.arange(0.004, lasts, 1.0 / RATE)
            pixels = camera.project(at(times))
            pixels += noise * rng.standard_normal((len(times), 2))
            spread = np.tile(noise**2 * np.eye(2), (len(times), 1, 1))
            written, own = times * (1.0 + errors.clock), np.zeros(len(times), dtype=np.int64)
            seen = Sightings((CAMERA.name,), own, written, pixels, spread)
            found.append(sighted_track(f"{len(found):03d}", seen, [CAMERA], model=MODEL, surfaces=SURFACES))
    return found


def _drawn(
    place: np.ndarray, to: float, rng: np.random.Generator, truth: AnalyticModel, scatter: bool
) -> tuple[float, Callable[[np.ndarray], np.ndarray]] | None:
    """A stroke's duration, s, and what gives its positions (n, 3) m at times (n,) s; None if none was drawn."""
    if not scatter:
        plain = stroke(place, to, rng, truth)
        return None if plain is None else (plain[1], lambda times: flown(plain[0], times, truth)[:, POSITION])
    one = scattered(0.0, place, to, truth, rng)
    return None if one is None else (one.end, lambda times: np.array([one.at(float(t))[POSITION] for t in times]))


def write_folder(folder: Path, tracks: Sequence[Track]) -> Path:
    """The folder of a dataset of sightings by the camera."""
    folder.mkdir()
    info = DatasetInfo("strokes", TABLE, TABLE_TENNIS, table_extent=SURFACES.extent)
    write_info(folder / "dataset.yaml", info)
    write_cameras(folder / "cameras.yaml", [replace(CAMERA)])
    write_sightings(folder / "detections.csv", [(track.name, sightings_of(track).sightings) for track in tracks])
    return folder
