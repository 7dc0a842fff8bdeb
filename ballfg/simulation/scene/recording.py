"""A recording holds the balls, the cameras and their frames before drawing; here it is also written as files."""

import glob
import itertools
import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import yaml

from ballfg.checks import listed, shown, type_name
from ballfg.files.strict_yaml import read_mapping
from ballfg.files.whole_folder import check_replaceable, whole_folder
from ballfg.progress import Watch, unwatched
from ballfg.simulation.scene.config import Clock, SceneConfig
from ballfg.simulation.scene.renderer import Renderer
from ballfg.simulation.scene.shutter import PATH_POINTS, Flight, Frames, Passage, fly_shots, frames_of, passages_of
from ballfg.state import STATE_NAMES
from ballfg.tracks import TableWriter
from ballfg.vision.arrays import Image
from ballfg.vision.camera import Camera
from ballfg.vision.camera_file import CAMERAS_FILE, write_cameras
from ballfg.vision.detection.video import write_video


@dataclass(frozen=True, eq=False)
class Recording:
    """Balls and frames of a recording. Cameras are counted in the order of `cameras`."""

    config: SceneConfig  # The settings
    cameras: tuple[Camera, ...]  # The rig
    flights: tuple[Flight, ...]  # The balls, in the order of their launches
    frames: tuple[Frames, ...]  # Frames of each camera
    passages: tuple[tuple[Passage, ...], ...]  # Passages of each camera, in the order of `flights`

    def clock(self, name: str) -> Clock:
        """The clock of the camera with this name."""
        return self.config.clocks.get(name, Clock())

    def images(self, number: int) -> Iterator[Image]:
        """Images (h, w, 3) in grey levels, blue green red, of the camera with this number, frame by frame."""
        renderer = Renderer(self.config, self.cameras[number], number)
        return renderer.frames(self.frames[number], self.passages[number])

    @property
    def image_count(self) -> int:
        """Number of frames of all cameras together."""
        return sum(len(frames.times) for frames in self.frames)


def record(config: SceneConfig, cameras: Sequence[Camera]) -> Recording:
    """Launches the balls and opens the shutters; images are drawn on demand.

    Args: cameras: with unique names; `ballfg.simulation.cameras.table_rig` makes a rig.
    Raises: ValueError: no camera, two of one name, or a clock of an unknown camera.
    """
    names = [camera.name for camera in cameras]
    if not names or len(set(names)) < len(names):
        raise ValueError(f"cameras must be at least one, with names of their own; got {', '.join(names) or 'none'}.")
    for name in config.clocks:
        if name not in names:
            raise ValueError(f"clocks must be of cameras {listed(names)}; got one of {shown(name)}. Rename it.")
    flights = fly_shots(config)
    frames = [frames_of(config, camera, number, flights) for number, camera in enumerate(cameras)]
    passages = [tuple(passages_of(config, flights, taken)) for taken in frames]
    return Recording(config, tuple(cameras), tuple(flights), tuple(frames), tuple(passages))


def visible_columns(recording: Recording, number: int) -> dict[str, Any]:
    """The table of one camera, for the evaluation of tracks: a row for each frame and ball centre in the image.

    Columns: `camera`; `frame`, counted from 0 over the written frames; `t` (s), its stamp; `t_true` (s), the true time
    of the middle of its exposure; `trajectory`, the ball's; `u,v` (px), its centre in the middle of the exposure;
    `u_open,v_open,u_close,v_close` (px), its centre as the shutter opens and closes; `radius` (px), the mean one of its
    outline; `whole`, 1 if all of its outline lies in the image throughout the exposure, else 0.
    """
    camera, frames = recording.cameras[number], recording.frames[number]
    rows: list[dict[str, Any]] = []
    for passage in recording.passages[number]:
        pixels = camera.project(passage.paths)
        seen = camera.holds(pixels[:, PATH_POINTS // 2])
        pixels, frame = pixels[seen], passage.frames[seen]
        focal = np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1])
        radius = focal * recording.config.ball.ball.radius / camera.depth(passage.centres[seen])
        ends = {"": PATH_POINTS // 2, "_open": 0, "_close": -1}
        places = {f"{axis}{end}": pixels[:, place, k] for end, place in ends.items() for k, axis in enumerate("uv")}
        row = {"frame": frame, "t": frames.stamps[frame], "t_true": frames.times[frame]}
        whole = np.asarray(camera.holds(pixels, radius[:, None]).all(axis=1), dtype=np.int64)
        row |= {"trajectory": np.full(len(frame), passage.name), **places, "radius": radius, "whole": whole}
        rows.append(row)
    return {"camera": camera.name} | {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}


SCENE_FILE: Final = "scene.yaml"
TRUTH_RATE: Final = 1000.0
"""Hz, rows of `truth.csv`: between them a line is off by less than 2 micrometres, except over a bounce."""


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
    stage: Path, camera: Camera, rate: float, drawn: Iterator[Image], count: int, *, images: bool
) -> None:
    """Takes the next `count` images and writes them as one video, or as files of a folder."""
    if images:
        (stage / camera.name).mkdir()
        for number in range(count):
            path = stage / camera.name / f"{number:06d}.png"
            if not cv2.imwrite(str(path), next(drawn)):
                raise OSError(f"{path}: OpenCV could not write the image. Check the space on the disk.")
        return
    video = itertools.islice(drawn, count)
    write_video(stage / f"{camera.name}.mp4", video, rate, camera.size, "Write images instead.")


def _write_truth(path: Path, recording: Recording) -> None:
    with TableWriter(path) as table:
        for flight in recording.flights:
            count = int(np.floor((flight.end - flight.start) * TRUTH_RATE)) + 1
            times = np.minimum(flight.start + np.arange(count) / TRUTH_RATE, flight.end)
            states = dict(zip(STATE_NAMES, flight.states(times).T, strict=True))
            table.write({"trajectory": flight.name, "t": times, **states})
