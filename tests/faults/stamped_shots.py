"""The same shots and detections on a clock that begins at a given shift, written to the microsecond."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from ballfg.simulation import MeasurementNoise, MotionNoise, SimulationConfig, write_simulation
from ballfg.vision.camera_file import write_cameras
from tests.estimation.observations.sighted_rig import RIG, launch, truth, world


def text(microseconds: int) -> str:
    """A stamp in s."""
    return f"{microseconds // 10**6}.{microseconds % 10**6:06d}"


def write_shots(folder: Path, shift: int, tracks: int, seed: int) -> Path:
    """A simulated dataset; its trajectories begin some seconds after one another, on a clock that begins at a shift."""
    noise = MeasurementNoise(position=0.002)
    folder.mkdir(parents=True, exist_ok=True)
    write_simulation(folder / "shots", SimulationConfig(tracks, 120.0, seed=seed, noise=noise, process=MotionNoise()))
    table = folder / "shots" / "tracks.csv"
    with table.open() as file:
        rows = list(csv.DictReader(file))
    first: dict[str, int] = {}
    for row in rows:
        begin = first.setdefault(row["trajectory"], len(first) * 3_700_000)
        row["t"] = text(shift + begin + round(1e6 * float(row["t"])))
    with table.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return folder / "shots"


def write_detections(folder: Path, shift: int) -> tuple[Path, Path]:
    """What three cameras saw of two balls one after the other, and the rig."""
    write_cameras(folder / "cameras.yaml", RIG)
    rows = []
    for number in range(2):
        rng = np.random.default_rng(number)
        times = np.arange(60) / 120.0
        states = truth(launch(rng), times, world())
        for camera in RIG:
            for time, state in zip(times, states, strict=True):
                if camera.in_view(state[:3]):
                    pixel = camera.project(state[:3]) + 0.3 * rng.standard_normal(2)
                    rows.append((shift + round(1e6 * (time + 2.0 * number)), camera.name, *np.ravel(pixel)))
    rows.sort(key=lambda row: row[0])
    with (folder / "detections.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("t", "camera", "u", "v", "sigma_u", "sigma_v", "score"))
        writer.writerows((text(t), name, u, v, 0.3, 0.3, 0.9) for t, name, u, v in rows)
    return folder / "detections.csv", folder / "cameras.yaml"
