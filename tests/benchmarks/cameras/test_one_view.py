"""The rows of one camera's strokes, on strokes whose truth is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from ballfg.benchmarks.cameras.one_view import METHOD, run_views
from ballfg.benchmarks.results import Results
from ballfg.dynamics.motion.rollout import rollout
from ballfg.estimation import read_sighted
from ballfg.tracks import Track
from ballfg.tracks.dataset import dataset_in_memory
from ballfg.tracks.info import TABLE_TENNIS, DatasetInfo, write_info
from ballfg.vision.camera_file import write_cameras
from tests.estimation.observations.sighted_rig import TABLE, world
from tests.estimation.observations.test_one_view import SIDE, pixels_of, stroke
from tests.written_tables import write_sightings

EXTENT = (-1.37, 1.37, -0.76, 0.76)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three strokes from the side."""
    write_info(tmp_path / "dataset.yaml", DatasetInfo("side", TABLE, TABLE_TENNIS, table_extent=EXTENT))
    write_cameras(tmp_path / "cameras.yaml", [SIDE])
    made = {f"{seed:03d}": stroke(world(), seed) for seed in range(3)}
    seen = {name: pixels_of(states[:, :3], times, SIDE, 2.0) for name, (times, states) in made.items()}
    write_sightings(tmp_path / "detections.csv", seen.items())
    return tmp_path


def test_rows_of_a_view(folder: Path) -> None:
    ball, tracks = world(), []
    for seed in range(3):
        times, states = stroke(ball, seed)
        fine = np.arange(0.0, times[-1] + 1e-9, 0.005)
        with torch.no_grad():
            path = rollout(ball.model, torch.from_numpy(states[:1]), torch.from_numpy(fine), ball.surfaces)[0].numpy()
        tracks.append(Track(fine, path[:, :3], name=f"{seed:03d}"))
    info = DatasetInfo("strokes", TABLE, TABLE_TENNIS, position_noise=0.001, table_extent=EXTENT)
    results = Results("ballfg-bench cameras", 0)
    run_views(results, [read_sighted(folder)], dataset_in_memory(info, tracks))
    value = {row.metric: row.value for row in results.rows if (row.case, row.method) == ("side", METHOD)}
    assert value["error_median"] < 60.0
    assert value["failures"] == 0.0
    assert value["coverage_90_x"] > 0.7
    assert value["bounce_time_median"] < 5.0
    assert value["bounce_place_median"] < 30.0
    strange = dataset_in_memory(info, [Track(tracks[0].times, tracks[0].positions, name="strange")])
    with pytest.raises(ValueError, match=r"it holds none\. Give views of its strokes"):
        run_views(results, [read_sighted(folder)], strange)
