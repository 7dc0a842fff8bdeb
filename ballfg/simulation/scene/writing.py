"""Writes a recording as files: videos or images, stamps, cameras, and the truth of every ball and frame."""

import glob
import itertools
import os
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from ballfg.checks import shown, type_name
from ballfg.files.strict_yaml import read_mapping
from ballfg.files.whole_folder import check_replaceable, whole_folder
from ballfg.progress import Watch, unwatched
from ballfg.simulation.scene.recording import Recording, visible_columns
from ballfg.state import STATE_NAMES
from ballfg.tracks import TableWriter
from ballfg.vision.camera import Camera
from ballfg.vision.camera_file import CAMERAS_FILE, write_cameras

Pixels = NDArray[np.uint8]

SCENE_FILE: Final = "scene.yaml"
TRUTH_RATE: Final = 1000.0
"""Hz, rows of `truth.csv`: between them a line is off by less than 2 micrometres, except over a bounce."""
CODEC: Final = "mp4v"  # MPEG-4 part 2: every build of OpenCV writes and reads it


def write_scene(
    folder: str | os.PathLike[str],
    recording: Recording,
    *,
    images: bool = False,
    force: bool = False,
    watch: Watch = unwatched,
) -> None:
    """Renders a recording and writes it; all files appear together at the end, or none.

    - `NAME.mp4` (or, with `images`, a folder `NAME` of PNG files, without any loss) and `NAME_stamps.csv` (`t`, one row
      a frame) for each camera;
    - `cameras.yaml`: the exact cameras, without undeclared delays of their stamps;
    - `truth.csv`: `trajectory,t` and the true state, every millisecond of true time;
    - `visible.csv`: the place of each ball in each frame: see `recording.visible_columns`;
    - `scene.yaml`: all settings, with the clocks.

    Args:
        folder: new or empty; its parent must exist.
        images: PNG files in place of videos.
        force: replace an existing scene.
        watch: called with the drawn images.
    Raises:
        ValueError: other content in the folder, or a camera's name that cannot be a file's name.
        FileNotFoundError: the folder's parent does not exist.
        OSError: OpenCV cannot write a video or an image here.
    """
    path = Path(folder)
    check_scene_folder(path, force=force)
    for camera in recording.cameras:
        if camera.name != Path(camera.name).name or camera.name.startswith("."):
            raise ValueError(f"camera names must be good as file names; got {shown(camera.name)}. Rename it.")
    scene = path / SCENE_FILE
    earlier = [glob.escape(name) for name in earlier_files(scene)]
    with whole_folder(path, earlier=earlier) as stage:
        check_scene_folder(path, force=force)
        every_image = itertools.chain.from_iterable(map(recording.images, range(len(recording.cameras))))
        drawn = watch(every_image, recording.image_count, "frames drawn")
        for number, camera in enumerate(recording.cameras):
            _write_images(
                stage, camera, recording.config.rate, drawn, len(recording.frames[number].times), images=images
            )
            with TableWriter(stage / f"{camera.name}_stamps.csv") as table:
                table.write({"t": recording.frames[number].stamps})
        write_cameras(stage / CAMERAS_FILE, recording.cameras)
        _write_truth(stage / "truth.csv", recording)
        with TableWriter(stage / "visible.csv") as table:
            for number in range(len(recording.cameras)):
                table.write(visible_columns(recording, number))
        content = scene_content(recording) | {"files": sorted(entry.name for entry in stage.iterdir())}
        (stage / SCENE_FILE).write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


def earlier_files(scene: Path) -> list[str]:
    """Names of the files of an earlier scene. Raises: ValueError: its file was damaged."""
    names = read_mapping(scene).get("files") if scene.is_file() else []
    if not isinstance(names, list):
        raise ValueError(
            f"{scene}: files must be a list of names; got {type_name(names)}. Delete the scene, and render it again."
        )
    return [str(name) for name in names]


def check_scene_folder(folder: Path, *, force: bool) -> None:
    """Refuses a folder that holds other files, or a rendered scene and no `force`; see `check_replaceable`."""
    check_replaceable(folder, mark=SCENE_FILE, what="a rendered scene", force=force)


def scene_content(recording: Recording) -> dict[str, Any]:
    """The content of `scene.yaml`: all settings of the recording."""
    config = recording.config
    return {
        **{name: getattr(config, name) for name in ("seed", "shots", "interval", "rate", "exposure")},
        "clocks": {camera.name: asdict(recording.clock(camera.name)) for camera in recording.cameras},
        **{name: getattr(config, name) for name in ("dropout", "jitter", "colour", "noise", "flicker", "distractors")},
        "settings": {name: list(levels) for name, levels in config.settings.items()},
        "undeclared": {effect.name: effect.values() for effect in config.undeclared},
        "flights": {f.name: {"start": f.start, "end": f.end} for f in recording.flights},
    }


def _write_images(
    stage: Path, camera: Camera, rate: float, drawn: Iterator[Pixels], count: int, *, images: bool
) -> None:
    """Takes the next `count` images and writes them as one video, or as files of a folder."""
    if images:
        (stage / camera.name).mkdir()
        for number in range(count):
            path = stage / camera.name / f"{number:06d}.png"
            if not cv2.imwrite(str(path), next(drawn)):
                raise OSError(f"{path}: OpenCV could not write the image. Check the space on the disk.")
        return
    path = stage / f"{camera.name}.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*CODEC), rate, camera.size)
    if not writer.isOpened():
        raise OSError(f"{path}: OpenCV cannot write {CODEC} videos here. Write images instead.")
    try:
        for _ in range(count):
            writer.write(next(drawn))
    finally:
        writer.release()


def _write_truth(path: Path, recording: Recording) -> None:
    with TableWriter(path) as table:
        for flight in recording.flights:
            count = int(np.floor((flight.end - flight.start) * TRUTH_RATE)) + 1
            times = np.minimum(flight.start + np.arange(count) / TRUTH_RATE, flight.end)
            states = dict(zip(STATE_NAMES, flight.states(times).T, strict=True))
            table.write({"trajectory": flight.name, "t": times, **states})
