"""Draws a camera's view of the still room by following every ray of the image."""

from dataclasses import dataclass
from functools import partial
from typing import Final

import cv2
import numpy as np

from ballfg.arrays import Array, Index, Mask
from ballfg.checks import shown
from ballfg.simulation.balls import BallKind
from ballfg.simulation.scene import room
from ballfg.vision.arrays import Array32, Image
from ballfg.vision.camera import Camera

SAMPLES: Final = 6  # Number of rays along each axis of a pixel on an edge: an edge is drawn to a twelfth of a pixel
EDGE_REACH: Final = 5  # px, side of the finely drawn square around an edge
TEXTURE_SIDE: Final = 512  # Number of texels along a side of the repeated texture
TEXELS_PER_METRE: Final = 90.0  # About one texel to four pixels at 3 m: smooth for a camera, yet nowhere flat
TEXTURE_DEPTH: Final = 0.09  # Standard deviation of the texture, relative to the colour
ROW: Final = 1024  # Number of points looked up in the texture as one row: OpenCV counts rows and columns in 16 bits
FACES: Final = 6
"""Numbers of faces for each box: across x, y and z, and a line on the last. Two opposite faces are never neighbours."""
_SIDE_LIGHT: Final = (0.72, 0.85, 1.0)  # Light on faces across x, y and z, relative to that from straight above


@dataclass(frozen=True, eq=False)
class Backdrop:
    """The still picture of a camera, before the lens blurs it."""

    image: Array32  # (h, w, 3) blue, green, red, grey levels
    distance: Array32  # (h, w) m, from the camera to the visible surface


def backdrop(camera: Camera, kind: BallKind, rng: np.random.Generator) -> Backdrop:
    """Draws the room in a camera's view; the same generator state gives every camera the same textures.

    Args: camera: must stand in the room.
    Raises: ValueError: the camera stands outside the room.
    """
    if not ((room.WALLS[0] < camera.centre) & (camera.centre < room.WALLS[1])).all():
        raise ValueError(
            f"camera {shown(camera.name)} must stand in the room, {room.WALLS[0].tolist()} to {room.WALLS[1].tolist()} "
            f"m; it stands at {np.round(camera.centre, 2).tolist()} m. Lower the distance."
        )
    boxes = room.furniture(kind)
    look = partial(_look, camera, boxes, _texture(rng))
    width, height = camera.size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    colours, distance, faces = look(pixels.reshape(-1, 2))
    image = colours.reshape(height, width, 3)
    edges = _edges(faces.reshape(height, width), camera.project(room.middle_line(boxes[0])))
    places = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    within = np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)
    fine, _, _ = look((pixels[edges][:, None] + within).reshape(-1, 2))
    image[edges] = fine.reshape(-1, SAMPLES**2, 3).mean(axis=1)
    return Backdrop(image, distance.reshape(height, width))


def _edges(faces: Image, thin: Array) -> Mask:
    """(h, w) pixels around borders of faces, and those near pixels (n, 2) of a thin line."""
    around = np.ones((EDGE_REACH, EDGE_REACH), dtype=np.uint8)
    column, row = np.round(thin[np.isfinite(thin).all(axis=1)]).astype(int).T
    shown = (column >= 0) & (column < faces.shape[1]) & (row >= 0) & (row < faces.shape[0])
    line = np.zeros_like(faces)
    line[row[shown], column[shown]] = 1
    return np.asarray((cv2.dilate(faces, around) != cv2.erode(faces, around)) | (cv2.dilate(line, around) > 0))


def _look(camera: Camera, boxes: list[room.Box], texture: Array32, pixels: Array) -> tuple[Array32, Array32, Image]:
    """Colours (n, 3), distance (n,) m and faces (n,), white lines among them, of what is visible at pixels (n, 2)."""
    rays = (camera.normalized(pixels) @ camera.rotation[:2] + camera.rotation[2]).astype(np.float32)
    start = camera.centre.astype(np.float32)
    length, axis = _exit(start, rays, *room.WALLS)
    points = start + rays * length[:, None]
    colours = _walls(points, axis, texture)
    faces = axis.astype(np.uint8)
    for number, box in enumerate(boxes, start=1):
        window = np.flatnonzero(_may_show(camera, box, pixels))
        near, across, hits = _entry(start, rays[window], box.low, box.high)
        hits &= near < length[window]
        if hits.any():
            hit = window[hits]
            points = start + rays[hit] * near[hits][:, None]
            lines = box.lined & (across[hits] == 2) & room.is_line(box, points[:, 0], points[:, 1])
            colours[hit] = _box_colour(box, points, across[hits], lines, texture)
            faces[hit] = FACES * number + across[hits] + 3 * lines
            length[hit] = near[hits]
    return colours, length * np.linalg.norm(rays, axis=-1), faces


def _may_show(camera: Camera, box: room.Box, pixels: Array) -> Mask:
    """(n,) True for pixels (n, 2) that may show a box; all if the lens cannot show all of its corners."""
    margin = 24 + camera.size[0] // 40  # straight edges bend between their corners
    corners = camera.project(box.corners())
    if not np.isfinite(corners).all():
        return np.ones(len(pixels), dtype=bool)
    (left, top), (right, bottom) = corners.min(axis=0) - margin, corners.max(axis=0) + margin
    u, v = pixels[:, 0], pixels[:, 1]
    return np.asarray((u >= left) & (u <= right) & (v >= top) & (v <= bottom))


def _slabs(start: Array32, rays: Array32, low: Array, high: Array) -> tuple[Array32, Array32]:
    """(n, 3) lengths at which rays enter and leave the three pairs of planes of a box."""
    with np.errstate(divide="ignore", invalid="ignore"):  # a ray along a plane never meets it: infinity
        to_low = (low.astype(np.float32) - start) / rays
        to_high = (high.astype(np.float32) - start) / rays
    return np.minimum(to_low, to_high), np.maximum(to_low, to_high)


def _exit(start: Array32, rays: Array32, low: Array, high: Array) -> tuple[Array32, Index]:
    """Length (n,) at which rays from inside a box leave it, and across which axis."""
    _, leave = _slabs(start, rays, low, high)
    axis = leave.argmin(axis=-1)
    return np.take_along_axis(leave, axis[..., None], axis=-1)[..., 0], axis


def _entry(start: Array32, rays: Array32, low: Array, high: Array) -> tuple[Array32, Index, Mask]:
    """Length (n,) at which rays enter a box from outside, across which axis, and whether they do."""
    enter, leave = _slabs(start, rays, low, high)
    axis = enter.argmax(axis=-1)
    near = np.take_along_axis(enter, axis[..., None], axis=-1)[..., 0]
    return near, axis, (near < leave.min(axis=-1)) & (near > 0)


def _walls(points: Array32, axis: Index, texture: Array32) -> Array32:
    """(n, 3) colours of points on the walls, the floor and the ceiling."""
    level = points[..., 2]
    colours = np.empty_like(points)
    colours[...] = room.WALL_COLOUR
    flat = axis == 2
    colours[flat & (level < 1.0)] = room.FLOOR_COLOUR
    colours[flat & (level >= 1.0)] = room.CEILING_COLOUR
    return colours * _shade(points, axis, texture)


def _box_colour(box: room.Box, points: Array32, axis: Index, lines: Mask, texture: Array32) -> Array32:
    """(n, 3) colours of points on a box, some of them on the lines of the table."""
    colours = np.empty_like(points)
    colours[...] = box.colour
    if box.lined:
        colours[axis == 2] = room.TABLE_COLOUR
        colours[lines] = room.LINE_COLOUR
    return colours * _shade(points, axis, texture)


def _shade(points: Array32, axis: Index, texture: Array32) -> Array32:
    """(n, 1) light on points of faces across an axis, times the texture there."""
    across = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    places = np.take_along_axis(points, across, axis=-1) * np.float32(TEXELS_PER_METRE)
    rows = np.pad(places, ((0, -len(places) % ROW), (0, 0))).reshape(-1, ROW, 2)
    grain = cv2.remap(texture, rows[..., 0], rows[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    grain = grain.reshape(-1)[: len(points)]
    light = np.array(_SIDE_LIGHT, dtype=np.float32)[axis] * (1 + np.float32(TEXTURE_DEPTH) * grain)
    return np.asarray(light[..., None], dtype=np.float32)


def _texture(rng: np.random.Generator) -> Array32:
    """(side, side) smooth noise that repeats, mean 0, standard deviation 1: four octaves."""
    total = np.zeros((TEXTURE_SIDE, TEXTURE_SIDE), dtype=np.float32)
    for cells, weight in ((4, 1.0), (16, 0.7), (64, 0.5), (256, 0.35)):
        grid = rng.standard_normal((cells, cells)).astype(np.float32)
        wrapped = np.pad(grid, 2, mode="wrap")
        scale = TEXTURE_SIDE // cells
        fine = cv2.resize(wrapped, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        total += np.float32(weight) * fine[2 * scale : -2 * scale, 2 * scale : -2 * scale]
    return np.asarray((total - total.mean()) / total.std(), dtype=np.float32)
