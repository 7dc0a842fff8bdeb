"""A good file of every kind that ballfg reads, in a folder of its own for each reader."""

from __future__ import annotations

import shutil
from collections.abc import Collection
from pathlib import Path

import cv2
import numpy as np
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
import yaml

from ballfg.simulation import SimulationConfig, simulate
from ballfg.vision.camera_file import write_cameras, write_opencv
from tests.estimation.observations.sighted_rig import RIG, scene, world
from tests.faults.seeds_of_models import (
    write_ball,
    write_calibration_config,
    write_calibration_steps,
    write_checkpoint_folder,
    write_conformal,
    write_learned,
    write_model,
    write_noise,
    write_records,
    write_report,
    write_sequence,
    write_training,
)
from tests.importing.test_forms import FORMS
from tests.pages.made import Fall, make

INFO = """\
name: fuzzed
frame: {up: z, table_height: 0.76, table: {x: [0.0, 2.74], y: [-0.7625, 0.7625]}}
ball: {radius: 0.02, mass: 0.0027}
rate: 120
position_noise: 0.003
spin_noise: 5.0
source: made
licence: MIT
noise: {position: [0.003, 0.004, 0.005], memory: [0.001, 0, 0.002], coefficients: {flight.drag.k: 0.01}}
"""


def write_seeds(folder: Path, only: Collection[str] | None = None) -> None:
    """Writes `folder/<reader>/...` for some readers of `tests.faults.readers`, all of them by default."""
    shots = [one.track for one in simulate(SimulationConfig(2, rate=120.0, seed=3))]
    for name in _WRITERS:
        if only is None or name in only:
            write_reader(folder, name)
    for form in FORMS:
        place = folder / f"import_{form.__name__}"
        if only is None or place.name in only:
            place.mkdir(parents=True)
            form(place, shots)


def write_reader(folder: Path, name: str) -> None:
    """Writes the good files of one reader. Args: folder: of all readers.  name: of a reader."""
    (folder / name).mkdir(parents=True)
    _WRITERS[name](folder / name)


def _dataset(folder: Path) -> None:
    made = make(folder.with_name(f".{folder.name}"), {"a": Fall(samples=20), "b": Fall(0.5, (-4.0, 0.5), 20)})
    (folder / "dataset.yaml").write_text(INFO)
    shutil.move(made.dataset / "tracks.csv", folder / "tracks.csv")
    shutil.rmtree(made.dataset.parent)
    (folder / "labels.csv").write_text(
        "trajectory,spin_x,spin_y,spin_z,topspin,group,colour\na,1,2,3,0.5,one,red\nb,,,,1,two,\n"
    )
    (folder / "speeds.csv").write_text("trajectory,t,speed,sigma\na,0.05,3.0,0.1\nb,0.1,4.0,0.1\n")
    (folder / "spins.csv").write_text("trajectory,t,wx,wy,wz,sigma\na,0.05,3.0,0.1,2.0,5.0\nb,0.1,4.0,1.0,2.0,5.0\n")


def _parquet_dataset(folder: Path) -> None:
    _dataset(folder)
    pq.write_table(pa_csv.read_csv(folder / "tracks.csv"), folder / "tracks.parquet")
    for name in ("tracks.csv", "labels.csv", "speeds.csv", "spins.csv"):
        (folder / name).unlink()


def _sighted(folder: Path) -> None:
    from tests.written_tables import write_sightings

    (folder / "dataset.yaml").write_text(INFO)
    write_cameras(folder / "cameras.yaml", RIG)
    balls = {name: scene(seed, world(), duration=0.1).sightings for seed, name in enumerate(("one", "two"))}
    write_sightings(folder / "detections.csv", balls.items())
    (folder / "labels.csv").write_text("trajectory,speed\none,1\ntwo,2\n")


def _table(folder: Path) -> None:
    (folder / "table.yaml").write_text(
        "table_height: 0.76\nsigma: 0.5\ncameras:\n"
        "  left:  {near_left: [312.4, 540.1], near_right: [611.0, 655.8], far_left: [702.3, 301.2], net_post: [9, 3]}\n"
        "points:\n  net_post: [1.37, 0.915, 0.9125]\n"
    )


def _results(folder: Path) -> None:
    made = make(folder.with_name(f".{folder.name}"), {"a": Fall(samples=20), "b": Fall(0.5, (-4.0, 0.5), 40)})
    for path in (made.states, made.predictions):
        shutil.move(path, folder / path.name)
    pq.write_table(pa_csv.read_csv(folder / "states.csv"), folder / "states.parquet")
    shutil.rmtree(made.dataset.parent)


def _scene(folder: Path) -> None:
    content = {"seed": 1, "clocks": {"left": {"offset": 0.1}}, "files": ["cameras.yaml", "left.mp4", "truth.csv"]}
    (folder / "scene.yaml").write_text(yaml.safe_dump(content, sort_keys=False))


def _cameras(folder: Path) -> None:
    write_cameras(folder / "cameras.yaml", RIG)
    for ending in ("xml", "json", "yml"):
        write_opencv(folder / f"cameras.{ending}", RIG[:2])


def _detections(folder: Path) -> None:
    rows = [f"{0.01 * k},{camera.name},{100 + k},{200 - k},0.5,0.5,0.1,0.9" for k in range(8) for camera in RIG]
    (folder / "detections.csv").write_text("\n".join(("t,camera,u,v,sigma_u,sigma_v,rho_uv,score", *rows)) + "\n")
    (folder / "stamps.csv").write_text("frame,t\n" + "".join(f"{k},{0.02 * k}\n" for k in range(6)))


def _live(folder: Path) -> None:
    (folder / "stream.lines").write_text(
        '{"t": 0.0, "x": 1.0, "y": 2.0, "z": 1.5}\n[0.01, 1.0, 2.0, 1.5]\n'
        '{"t": 0.02, "position": [1, 2, 3], "sigma": 0.01}\n'
        '{"t": 0.03, "positions": [[1, 2, 3], [1, 2, 1]], "sigma": [[0.1, 0.1, 0.2], [0.1, 0.2, 0.1]]}\n'
    )
    (folder / "stream.csv").write_text("t,x,y,z,sigma_x,sigma_y,sigma_z\n0.0,1,2,1.5,0.1,0.1,0.1\n0.01,1,2,1.5,1,1,1\n")


def _video(folder: Path) -> None:
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 255, (32, 48, 3), dtype=np.uint8) for _ in range(6)]
    for name, codec in (("a.mp4", "mp4v"), ("a.avi", "MJPG")):
        writer = cv2.VideoWriter(str(folder / name), cv2.VideoWriter.fourcc(*codec), 50.0, (48, 32))
        for frame in frames:
            writer.write(frame)
        writer.release()
    (folder / "images").mkdir()
    for number, frame in enumerate(frames[:2]):
        cv2.imwrite(str(folder / "images" / f"{number}.png"), frame)
    cv2.imwrite(str(folder / "images" / "2.jpg"), frames[2])
    (folder / "stamps.csv").write_text("frame,t\n0,0.0\n1,0.02\n2,0.04\n")


_WRITERS = {
    "dataset": _dataset, "parquet_dataset": _parquet_dataset, "sighted": _sighted, "model": write_model,
    "learned": write_learned, "training": write_training, "calibration": write_calibration_config,
    "conformal": write_conformal, "ball": write_ball, "table": _table, "results": _results, "report": write_report,
    "checkpoint": write_checkpoint_folder, "sequence": write_sequence, "cameras": _cameras,
    "detections": _detections, "live": _live, "video": _video, "noise": write_noise, "steps": write_calibration_steps,
    "records": write_records, "scene": _scene,
}  # fmt: skip
