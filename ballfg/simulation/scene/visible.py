"""Which frames show which balls, and where: what detections and tracks are judged against."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ballfg.simulation.scene.recording import Recording
from ballfg.simulation.scene.shutter import PATH_POINTS
from ballfg.simulation.scene.view import inside
from ballfg.vision.camera import Camera


def visible_columns(recording: Recording, number: int) -> dict[str, Any]:
    """The table of one camera: a row for each frame and each ball whose centre lies in the image.

    Columns: `camera`; `frame`, counted from 0 over the frames that were written; `t` (s), its stamp; `t_true` (s), the
    true time of the middle of its exposure; `trajectory`, the ball's; `u,v` (px), where its centre is in the middle of
    the exposure; `u_open,v_open,u_close,v_close` (px), where it is as the shutter opens and closes; `radius` (px), of
    its outline; `whole`, 1 if all of its outline lies in the image throughout the exposure, else 0.
    """
    camera, frames = recording.cameras[number], recording.frames[number]
    rows: list[dict[str, Any]] = []
    for passage in recording.passages[number]:
        pixels = camera.project(passage.paths)
        seen = inside(camera, pixels[:, PATH_POINTS // 2])
        pixels, frame = pixels[seen], passage.frames[seen]
        radius = outline_radius(camera, passage.centres[seen], recording.config.ball.ball.radius)
        rows.append(
            {
                "frame": frame,
                "t": frames.stamps[frame],
                "t_true": frames.times[frame],
                "trajectory": np.full(len(frame), passage.name),
                "u": pixels[:, PATH_POINTS // 2, 0],
                "v": pixels[:, PATH_POINTS // 2, 1],
                "u_open": pixels[:, 0, 0],
                "v_open": pixels[:, 0, 1],
                "u_close": pixels[:, -1, 0],
                "v_close": pixels[:, -1, 1],
                "radius": radius,
                "whole": inside(camera, pixels, radius[:, None]).all(axis=1).astype(np.int64),
            }
        )
    return {"camera": camera.name} | {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}


def outline_radius(camera: Camera, centres: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    """(n,) px, mean radius of the outlines of balls of a radius in m at centres (n, 3) m."""
    return np.asarray(np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]) * radius / camera.depth(centres))
