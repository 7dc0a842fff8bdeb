"""A recording holds the balls, the cameras, and the content of each camera's frames, before drawing."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ballfg.checks import listed, shown
from ballfg.simulation.scene.config import Clock, SceneConfig
from ballfg.simulation.scene.flights import Flight, duration, fly_shots
from ballfg.simulation.scene.renderer import Renderer
from ballfg.simulation.scene.room import inside
from ballfg.simulation.scene.shutter import PATH_POINTS, Frames, Passage, frames_of, passages_of
from ballfg.vision.camera import Camera


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

    def images(self, number: int) -> Iterator[NDArray[np.uint8]]:
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
    until = duration(flights)
    frames = [frames_of(config, camera, number, until) for number, camera in enumerate(cameras)]
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
        seen = inside(camera, pixels[:, PATH_POINTS // 2])
        pixels, frame = pixels[seen], passage.frames[seen]
        focal = np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1])
        radius = focal * recording.config.ball.ball.radius / camera.depth(passage.centres[seen])
        ends = {"": PATH_POINTS // 2, "_open": 0, "_close": -1}
        places = {f"{axis}{end}": pixels[:, place, k] for end, place in ends.items() for k, axis in enumerate("uv")}
        row = {"frame": frame, "t": frames.stamps[frame], "t_true": frames.times[frame]}
        whole = np.asarray(inside(camera, pixels, radius[:, None]).all(axis=1), dtype=np.int64)
        row |= {"trajectory": np.full(len(frame), passage.name), **places, "radius": radius, "whole": whole}
        rows.append(row)
    return {"camera": camera.name} | {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
