"""A good file of every kind that ballfg reads, in a folder of its own for each reader."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
import torch
from safetensors.torch import save_file

from ballfg.dynamics import Architecture, SpinEmbedding, Trained, build, nominal_model, save_model
from ballfg.dynamics.networks.fading import Fading
from ballfg.learning.run.checkpoint import write_checkpoint
from ballfg.learning.run.metrics import Epoch, write_metrics
from ballfg.simulation import SimulationConfig, simulate
from ballfg.vision.camera_file import write_cameras, write_opencv
from tests.estimation.observations.sighted_rig import RIG, scene, world
from tests.importing.test_forms import FORMS
from tests.learning.run.test_checkpoint import made as made_checkpoint
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
"""


def write_seeds(folder: Path) -> None:
    """Writes `folder/<reader>/...` for every reader of `tests.faults.readers`."""
    shots = [one.track for one in simulate(SimulationConfig(2, rate=120.0, seed=3))]
    for name, write in _WRITERS.items():
        (folder / name).mkdir(parents=True)
        write(folder / name)
    for form in FORMS:
        place = folder / f"import_{form.__name__}"
        place.mkdir()
        form(place, shots)


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
    from ballfg.tracks.detections_file import write_sightings

    (folder / "dataset.yaml").write_text(INFO)
    write_cameras(folder / "cameras.yaml", RIG)
    balls = {name: scene(seed, world(), duration=0.1).sightings for seed, name in enumerate(("one", "two"))}
    write_sightings(folder / "detections.csv", balls.items())
    (folder / "labels.csv").write_text("trajectory,speed\none,1\ntwo,2\n")


def _model(folder: Path) -> None:
    (folder / "model.yaml").write_text(
        "flight:\n  gravity: {g: 9.81}\n  drag: {k: 0.13}\n  magnus: {k: 0.003}\n"
        "bounce:\n  restitution: {e: 0.92}\n  friction: {mu: 0.25}\nmeasurement: {}\nlearned: null\n"
        "variations:\n  flight.drag.k: {by: group, values: {topspin: 0.148, no_spin: 0.110}}\n"
        "  bounce.restitution.e: {by: track, values: {'001': 0.93, '025': 0.88}, line: true}\n"
    )


def _learned(folder: Path) -> None:
    network = build(
        Architecture.of("mnn+gs", width_flight=6, width_contact=6, residual=True), radius=0.02, base=nominal_model()
    )
    network.fading = Fading.empty(4, 3, 0.02)
    network.trained = Trained(
        {"velocity": 0.2, "spin": 1.0}, 0.5, SpinEmbedding(("topspin", "side"), {"side": ("l", "r")})
    )
    save_model(network, folder / "model.yaml")


def _training(folder: Path) -> None:
    (folder / "train.yaml").write_text(
        "kind: mnn+gs\ndata: [shots]\nseed: 3\nobserve: {seconds: 0.25}\noptimizer: {epochs: 3}\n"
        "architecture: {width_flight: 8, residual: true}\n"
    )


def _calibration(folder: Path) -> None:
    (folder / "calibrate.yaml").write_text("kind: calibrate\ndata: shots\nseed: 3\n")


def _conformal(folder: Path) -> None:
    from ballfg.estimation.conformal import ConformalScales

    table = np.full((3, 3), 1.1)
    ConformalScales("shots", 0.4, "smoother", np.array([12, 11, 10]), table, table, table, {"converged": 12}).save(
        folder / "scales.yaml"
    )


def _ball(folder: Path) -> None:
    (folder / "squash.yaml").write_text(
        "name: squash\nradius: 0.02\nmass: 0.024\ninertia_factor: 0.6667\nsurface: court\n"
        "flight: {gravity: {}, drag: {k: 0.016}}\nbounce: {restitution: {e: 0.4}, friction: {mu: 0.5}}\n"
        "launcher: {duration: 1.0, speed_slow: 10, speed_fast: 25}\n"
    )


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


def _report(folder: Path) -> None:
    from ballfg.diagnosis.report.report import write_report
    from tests.diagnosis.made_diagnosis import found

    whole = folder.with_name(f".{folder.name}")
    write_report(found(), whole)
    content = json.loads((whole / "report.json").read_text(encoding="utf-8"))
    (folder / "report.json").write_text(json.dumps(content), encoding="utf-8")
    shutil.rmtree(whole)


def _checkpoint(folder: Path) -> None:
    write_checkpoint(folder, made_checkpoint(2))
    epochs = [Epoch(k, 1.0, 0.1, None, 1e-3, 2.0, 0, 0, 0, 1.5) for k in range(3)]
    write_metrics(folder / "metrics.csv", epochs)


def _sequence(folder: Path) -> None:
    from ballfg.learning.sequence.architecture import SequenceArchitecture

    model = SequenceArchitecture("lstm", 8).empty(0, 5)
    (folder / "config.yaml").write_text("kind: lstm\nwidth: 8\npoints: 5\nlabels: []\ncategories: {}\n")
    save_file(
        {name: torch.zeros_like(value) for name, value in model.state_dict().items()}, folder / "weights.safetensors"
    )


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
    "dataset": _dataset, "parquet_dataset": _parquet_dataset, "sighted": _sighted, "model": _model,
    "learned": _learned, "training": _training, "calibration": _calibration, "conformal": _conformal, "ball": _ball,
    "table": _table, "results": _results, "report": _report, "checkpoint": _checkpoint, "sequence": _sequence,
    "cameras": _cameras, "detections": _detections, "live": _live, "video": _video,
}  # fmt: skip


def write_odd(folder: Path) -> None:
    """Writes whole files with a content that no reader expects; they take the place of good ones."""
    folder.mkdir()
    for write in (_odd_parquet, _odd_hdf5, _odd_excel, _odd_matlab, _odd_arrays):
        write(folder)


def _odd_parquet(folder: Path) -> None:
    keys, numbers = pa.array(["a", "a", "b"]), pa.array([0.0, 1.0, 2.0])
    columns: dict[str, pa.Array] = {
        "decimal": pa.array([1, 2, 3]).cast(pa.decimal128(30, 5)), "text": pa.array(["1", "x", ""]),
        "none": pa.nulls(3), "list": pa.array([[1.0], [], [2.0, 3.0]]), "struct": pa.array([{"x": 1.0}] * 3),
        "date": pa.array([0, 1, 2], pa.timestamp("s")), "days": pa.array([0, 1, 2], pa.date32()),
        "far": pa.array([-(2**62), 0, 2**62], pa.timestamp("us")), "bool": pa.array([True, False, None]),
        "bytes": pa.array([b"\xff", b"", b"x"]), "words": keys.dictionary_encode(),
        "half": pa.array(np.array([1, 2, 3], np.float16)), "big": pa.array([2**64 - 1, 0, 1], pa.uint64()),
        "time": pa.array([1, 2, 3], pa.time64("ns")), "span": pa.array([1, 2, 3], pa.duration("ns")),
        "map": pa.array([[("a", 1)]] * 3, pa.map_(pa.string(), pa.int64())),
    }  # fmt: skip
    for name, column in columns.items():
        rest = {key: numbers for key in ("x", "y", "z")}
        pq.write_table(pa.table({"trajectory": keys, "t": column, **rest}), folder / f"stamps_{name}.parquet")
        pq.write_table(pa.table({"trajectory": column, "t": numbers, **rest}), folder / f"names_{name}.parquet")
    pq.write_table(pa.table({}), folder / "nothing.parquet")
    pq.write_table(pa.table({"t": pa.array([], pa.float64())}), folder / "no_rows.parquet")
    many = pa.array(np.zeros(40_000_000))  # 320 MB in memory, kilobytes in the file
    table = pa.table({name: many for name in ("t", "x", "y", "z")})
    pq.write_table(table, folder / "bomb.parquet", compression="zstd")


def _odd_hdf5(folder: Path) -> None:
    import h5py

    def one(name: str, fill: object) -> None:
        with h5py.File(folder / f"{name}.h5", "w") as file:
            fill(file)  # type: ignore[operator]

    one("nothing", lambda file: None)
    one("huge", lambda file: file.create_dataset("t", (10**9, 4), dtype="f8", chunks=(1000, 4)))
    one("huger", lambda file: file.create_dataset("t", (10**15,), dtype="f8", chunks=(1000,)))
    one(
        "many", lambda file: [file.create_dataset(f"t{k}", (10**7, 4), dtype="f8", chunks=(1000, 4)) for k in range(20)]
    )
    one("cycle", lambda file: file.create_group("a").__setitem__("b", file["/"]))
    one("soft", lambda file: file.__setitem__("a", h5py.SoftLink("/a")))
    one("outside", lambda file: file.__setitem__("a", h5py.ExternalLink("/etc/passwd", "/a")))
    one("text", lambda file: file.__setitem__("t", ["a", "b", "c"]))
    one("reference", lambda file: file.create_dataset("t", (3,), dtype=h5py.ref_dtype))
    one("ragged", lambda file: file.create_dataset("t", (3,), dtype=h5py.vlen_dtype(np.float64)))
    one("complex", lambda file: file.__setitem__("t", np.ones((4, 4), complex)))
    one("empty", lambda file: file.__setitem__("t", h5py.Empty("f")))
    one("compound", lambda file: file.__setitem__("t", np.zeros(4, [("t", "f8"), ("x", "f8", (3,)), ("n", "S3")])))
    one("five", lambda file: file.__setitem__("t", np.zeros((2, 2, 3, 3, 3))))

    def deep(file: object) -> None:
        group = file
        for _ in range(2000):
            group = group.create_group("g")  # type: ignore[attr-defined]

    one("deep", deep)


def _odd_excel(folder: Path) -> None:
    import openpyxl

    rows: Iterable[Iterable[object]]
    for name, rows in {
        "cells": [["t", "x", "y", "z"], [True, "=1/0", None, "#N/A"], ["1", 2, 3.5, "4"]],
        "nothing": [],
        "wide": [range(3000), range(3000), range(3000), range(3000)],
    }.items():
        book = openpyxl.Workbook()
        for row in rows:
            book.active.append(list(row))
        book.save(folder / f"{name}.xlsx")
    book = openpyxl.Workbook()
    book.active.cell(1_048_576, 16_384, 1.0)  # one cell at the far corner
    book.save(folder / "corner.xlsx")


def _odd_matlab(folder: Path) -> None:
    import scipy.io

    inner: dict[str, object] = {"t": np.arange(5.0)}
    for _ in range(40):
        inner = {"a": inner}
    for name, content in {
        "nothing": {}, "deep": inner, "text": {"t": "abc"}, "complex": {"t": np.ones((5, 4), complex)},
        "cells": {"t": np.array([1.0, "a", 2], dtype=object)}, "void": {"t": np.zeros((0, 4))},
    }.items():  # fmt: skip
        scipy.io.savemat(folder / f"{name}.mat", content)


def _odd_arrays(folder: Path) -> None:
    np.savez_compressed(folder / "bomb.npz", t=np.zeros((50_000_000, 4)))
    np.savez(folder / "pickled.npz", t=np.array([{"a": 1}], dtype=object), allow_pickle=True)
    np.savez(folder / "mixed.npz", t=np.arange(4.0), x=np.ones((4, 3, 2)), y=np.array("a"), z=np.zeros((0, 3)))
    np.save(folder / "dates.npy", np.arange(12).reshape(3, 4).astype("datetime64[s]"))
    np.save(folder / "five.npy", np.zeros((2, 2, 2, 3, 4)))
    np.save(folder / "none.npy", np.zeros((0, 4)))
