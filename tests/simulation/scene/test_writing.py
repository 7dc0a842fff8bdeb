"""A recording as files: what is written can be read, and nothing is half written."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pyarrow.csv as pa_csv
import pytest
import yaml
from numpy.typing import NDArray

from ballfg.simulation import parse_effects
from ballfg.simulation.cameras import table_rig
from ballfg.simulation.scene.config import Clock, SceneConfig
from ballfg.simulation.scene.recording import TRUTH_RATE, Recording, record, write_scene
from ballfg.vision.camera_file import read_cameras

FILES = {"cameras.yaml", "scene.yaml", "truth.csv", "visible.csv"} | {
    f"{name}{ending}" for name in ("left", "right", "far") for ending in (".mp4", "_stamps.csv")
}


@pytest.fixture(scope="module")
def recording() -> Recording:
    clocks = {"far": Clock(phase=0.002, offset=0.004)}
    config = SceneConfig(shots=1, rate=40.0, clocks=clocks, undeclared=parse_effects(["wind.x=0.3"]))
    return record(config, table_rig((160, 90)))


@pytest.fixture(scope="module")
def scene(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes") / "scene"
    write_scene(folder, recording)
    return folder


def column(path: Path, name: str) -> NDArray[np.float64]:
    return np.asarray(pa_csv.read_csv(path)[name].to_numpy())


def test_videos_have_a_frame_for_each_stamp(scene: Path, recording: Recording) -> None:
    assert {path.name for path in scene.iterdir()} == FILES
    for number, camera in enumerate(recording.cameras):
        video = cv2.VideoCapture(str(scene / f"{camera.name}.mp4"))
        images = []
        while (read := video.read())[0]:
            images.append(read[1])
        assert len(images) == len(recording.frames[number].times)
        assert images[0].shape == (90, 160, 3)
        drawn = list(recording.images(number))
        assert np.abs(images[30].astype(float) - drawn[30]).mean() < 4.0  # what compression takes
        stamps = column(scene / f"{camera.name}_stamps.csv", "t")
        np.testing.assert_array_equal(stamps, recording.frames[number].stamps)


def test_truth_can_be_read(scene: Path, recording: Recording) -> None:
    (flight,) = recording.flights
    times = column(scene / "truth.csv", "t")
    np.testing.assert_allclose(np.diff(times), 1 / TRUTH_RATE, atol=1e-9)
    assert flight.end - times[-1] < 1 / TRUTH_RATE
    states = np.column_stack([column(scene / "truth.csv", name) for name in ("x", "y", "z", "vx", "vy", "vz")])
    np.testing.assert_allclose(states, flight.states(times)[:, :6], atol=1e-12)
    for before, after in zip(recording.cameras, read_cameras(scene / "cameras.yaml"), strict=True):
        np.testing.assert_array_equal(before.project([1.0, 0.2, 1.0]), after.project([1.0, 0.2, 1.0]))
        assert (before.name, before.time_offset) == (after.name, after.time_offset)
    visible = pa_csv.read_csv(scene / "visible.csv")
    assert set(visible["camera"].to_pylist()) == {"left", "right", "far"}
    far = np.array(visible["camera"].to_pylist()) == "far"
    late = visible["t"].to_numpy() - visible["t_true"].to_numpy()
    np.testing.assert_allclose(late, np.where(far, 0.004, 0.0), atol=1e-12)


def test_scene_file_says_what_was_asked_for(scene: Path, recording: Recording) -> None:
    content = yaml.safe_load((scene / "scene.yaml").read_text(encoding="utf-8"))
    assert content["undeclared"] == {"wind": {"x": 0.3, "y": 0.0, "z": 0.0}}
    assert content["clocks"]["far"] == {"phase": 0.002, "offset": 0.004}
    assert content["clocks"]["left"] == {"phase": 0.0, "offset": 0.0}
    assert content["flights"]["000"]["start"] == recording.flights[0].start
    assert set(content["files"]) == FILES - {"scene.yaml"}


def test_the_same_recording_gives_the_same_bytes(scene: Path, recording: Recording, tmp_path: Path) -> None:
    write_scene(tmp_path / "again", recording)
    for path in scene.iterdir():
        assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes(), path.name


def test_images_lose_nothing_and_replace_videos(scene: Path, recording: Recording, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(scene, tmp_path / "scene"))
    (folder / "mine.txt").write_text("stays", encoding="utf-8")
    with pytest.raises(ValueError, match=r"holds a rendered scene\. Replace it with --force"):
        write_scene(folder, recording, images=True)
    write_scene(folder, recording, images=True, force=True)
    names = {path.name for path in folder.iterdir()}
    assert names == (FILES - {"left.mp4", "right.mp4", "far.mp4"}) | {"left", "right", "far", "mine.txt"}
    images = sorted((folder / "right").iterdir())
    assert len(images) == len(recording.frames[1].times)
    for path, drawn in zip(images, recording.images(1), strict=True):
        np.testing.assert_array_equal(cv2.imread(str(path)), drawn)


def test_nothing_is_half_written(recording: Recording, tmp_path: Path) -> None:
    def stops(images: Iterable[NDArray[np.uint8]], total: int, what: str) -> Iterator[NDArray[np.uint8]]:
        for count, image in enumerate(images):
            if count == 5:
                raise KeyboardInterrupt
            yield image

    with pytest.raises(KeyboardInterrupt):
        write_scene(tmp_path / "scene", recording, watch=stops)
    assert not (tmp_path / "scene").exists()


def test_refuses_folders(recording: Recording, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x", encoding="utf-8")
    with pytest.raises(ValueError, match="holds other files"):
        write_scene(tmp_path, recording)
    with pytest.raises(ValueError, match="is a file"):
        write_scene(tmp_path / "file", recording)
    with pytest.raises(FileNotFoundError, match="existing folder"):
        write_scene(tmp_path / "none" / "scene", recording)
