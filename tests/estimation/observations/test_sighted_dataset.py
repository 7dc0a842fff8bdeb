"""A dataset of detections: opened, estimated on the command line, refused where files are missing."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ballfg.cli.main import run
from ballfg.dynamics import EFFECTS, AnalyticModel, save_model
from ballfg.estimation.configure import dataset_settings, dataset_surfaces
from ballfg.estimation.observations.sighted_dataset import read_sighted
from ballfg.estimation.registry import make_estimator
from ballfg.state import SIGMA_NAMES, STATE_NAMES
from ballfg.tracks.info import TABLE_TENNIS, DatasetInfo, write_info
from ballfg.vision.camera_file import read_cameras, write_cameras
from ballfg.vision.detection.detections import read_detections
from tests.estimation.observations.sighted_rig import RIG, TABLE, Scene, launch, scene, seen, track_of, truth, world
from tests.written_tables import write_sightings


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scene]:
    return {name: scene(seed, world(), duration=0.3) for seed, name in enumerate(("one", "two"))}


@pytest.fixture
def folder(tmp_path: Path, scenes: dict[str, Scene]) -> Path:
    write_info(tmp_path / "dataset.yaml", DatasetInfo("seen", TABLE, TABLE_TENNIS))
    write_cameras(tmp_path / "cameras.yaml", RIG)
    lonely = scenes["one"].sightings.select(np.flatnonzero(scenes["one"].sightings.camera == 0)[:4])
    balls = {name: made.sightings for name, made in scenes.items()} | {"lonely": lonely}
    write_sightings(tmp_path / "detections.csv", balls.items())
    return tmp_path


def command(*arguments: object) -> int:
    with pytest.raises(SystemExit) as end:
        run([str(argument) for argument in arguments])
    return int(end.value.code or 0)


def test_dataset_holds_the_balls_that_were_seen_often_enough(folder: Path, scenes: dict[str, Scene]) -> None:
    (folder / "labels.csv").write_text("trajectory,spin_x,spin_y,spin_z\ntwo,1,2,3\n")
    dataset = read_sighted(folder)
    assert dataset.names == ["one", "two"]
    assert len(dataset.notes) == 1
    assert "track 'lonely': a ball that one camera saw must be seen 5 times" in dataset.notes[0]
    for track in dataset:
        plain = track_of(scenes[track.name], track.name)
        np.testing.assert_array_equal(track.times, plain.times)
        np.testing.assert_allclose(track.positions, plain.positions, atol=1e-9)
    np.testing.assert_array_equal(next(t for t in dataset if t.name == "two").spin_label, [1.0, 2.0, 3.0])


def test_estimate_command_reads_detections(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One row per distinct stamp, the numbers of the library; without a table of tracks no option is needed."""
    assert command("estimate", folder, "--out", folder / "states.csv", "--jobs", 1) == 0
    assert "lonely" in capsys.readouterr().err
    with (folder / "states.csv").open() as file:
        rows = list(csv.DictReader(file))
    dataset, model = read_sighted(folder), world().model
    settings = dataset_settings(dataset, model)
    expected = [make_estimator("smoother", model, dataset_surfaces(dataset), settings).estimate(t) for t in dataset]
    assert len(rows) == sum(len(estimate.times) for estimate in expected)
    for names, field in ((("t",), "times"), (STATE_NAMES, "states"), (SIGMA_NAMES, "sigmas")):
        read = np.array([[float(row[name]) for name in names] for row in rows])
        stated = np.concatenate([np.atleast_2d(getattr(e, field).T).T for e in expected])
        np.testing.assert_allclose(read, stated, rtol=1e-9, atol=1e-12)


def test_predict_command_reads_detections(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A row per stamp after the observed part; scales of measured positions are refused."""
    out = folder / "predictions.csv"
    assert command("predict", folder, "--observe", 0.2, "--out", out, "--jobs", 1) == 0
    with out.open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == sum(int((t.seconds > 0.2 + 1e-6).sum()) for t in read_sighted(folder))
    assert command("predict", folder, "--observe", 0.2, "--conformal", folder, "--out", out) == 2
    assert "conformal must not be given with detections" in capsys.readouterr().err


@pytest.mark.parametrize("gust", [0.0, 20.0])
def test_intervals_that_the_sightings_contradict(
    gust: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A gust (m/s^2) that begins after the observed part: what cameras saw lies outside of the intervals."""
    write_info(tmp_path / "dataset.yaml", DatasetInfo("seen", TABLE, TABLE_TENNIS))
    write_cameras(tmp_path / "cameras.yaml", RIG)
    times = np.repeat(np.arange(40) / 120.0, len(RIG)) + np.tile(np.arange(len(RIG)) / 360.0, 40)
    camera, balls = np.tile(np.arange(len(RIG)), 40), {}
    for seed in range(6):
        rng = np.random.default_rng(seed)
        states = truth(launch(rng), times, world())
        states[:, 1] += 0.5 * gust * np.maximum(times - 0.15, 0.0) ** 2
        balls[f"{seed}"] = seen(states, camera, times, rng).sightings
    write_sightings(tmp_path / "detections.csv", balls.items())
    assert command("predict", tmp_path, "--observe", 0.15, "--out", tmp_path / "p.csv", "--jobs", 1) == 0
    said = capsys.readouterr().out
    assert ("of what was measured there; check the cameras, or write positions" in said) == (gust > 0.0)


@pytest.mark.parametrize(
    ("size", "cause"),
    [((720, 1280), "They fit a picture of 1280x720: it is probably turned by 90 degrees"), ((640, 360), "They reach ")],
)
def test_sightings_outside_of_the_picture(folder: Path, size: tuple[int, int], cause: str) -> None:
    write_cameras(folder / "cameras.yaml", [replace(camera, size=size) for camera in RIG])
    rule = rf"camera '(left|back)' has a picture of {size[0]}x{size[1]} px, in which .* {cause}"
    with pytest.raises(ValueError, match=rule):
        read_sighted(folder)
    with pytest.raises(ValueError, match=cause):
        read_detections(folder / "detections.csv", read_cameras(folder / "cameras.yaml"))


@pytest.mark.parametrize(("gap", "cameras"), [(5.0, (0, 0)), (1000.0, (0, 0)), (5.0, (0, 1, 0))])
def test_a_ball_of_one_view_that_was_long_out_of_sight(folder: Path, gap: float, cameras: tuple[int, ...]) -> None:
    """Two cameras that take turns are one view too; their spans overlap."""
    seen = scene(0, world(), phases=(0.0, 0.0), duration=0.3).sightings
    parts = [seen.select(np.flatnonzero(seen.camera == camera)) for camera in cameras]
    late = [replace(part, times=part.times + (gap + 0.3) * k) for k, part in enumerate(parts)]
    write_sightings(folder / "detections.csv", [("one", part) for part in late])
    with pytest.raises(ValueError, match=r"must not be out of sight for more than 3 s; got (5|1000)\.?\d* s") as error:
        read_sighted(folder)
    assert str(error.value).startswith(f"{folder}: track 'one': ")


@pytest.mark.parametrize("late", [-20.0, 5.0, 1000.0, 1.7e9])
def test_cameras_whose_clocks_do_not_overlap(folder: Path, late: float) -> None:
    seen = scene(0, world(), duration=0.3).sightings
    times = seen.times + late * (seen.camera == 1)
    write_sightings(folder / "detections.csv", [("one", replace(seen, times=times))])
    said = "track 'one': videos must overlap in time, or follow one another within 3 s; camera 'right' overlaps with no"
    with pytest.raises(ValueError, match=said):
        read_sighted(folder)
    write_cameras(folder / "cameras.yaml", [RIG[0], replace(RIG[1], time_offset=late), RIG[2]])
    assert read_sighted(folder).names == ["one"]


def test_source_can_be_chosen(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = folder / "states.csv"
    assert command("estimate", folder, "--from", "positions", "--out", out) == 2
    assert "must hold tracks.csv or tracks.parquet" in capsys.readouterr().err
    assert command("estimate", folder, "--from", "pixels", "--out", out) == 2
    assert "'positions', 'detections'" in capsys.readouterr().err
    assert not out.exists()


def test_measurement_effects_need_positions(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = AnalyticModel([EFFECTS["gravity"](), EFFECTS["restitution"](), EFFECTS["scale"]()])
    save_model(model, folder / "model.yaml")
    assert command("estimate", folder, "--model", folder / "model.yaml", "--out", folder / "states.csv") == 2
    assert "model must have no measurement effects for a track that cameras saw" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["dataset.yaml", "cameras.yaml", "detections.csv"])
def test_missing_file_is_named(folder: Path, name: str) -> None:
    (folder / name).unlink()
    with pytest.raises(FileNotFoundError, match=f"{name} is missing"):
        read_sighted(folder)


def test_no_ball_is_refused(folder: Path) -> None:
    (folder / "detections.csv").write_text("trajectory,t,camera,u,v\n,0.1,left,1,2\n")
    with pytest.raises(ValueError, match=r"must hold a ball, seen often enough, .* got none \(0 named\)"):
        read_sighted(folder)
