"""Images of calibration boards as a camera with a bent lens would see them; and the poses they were seen from."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from ballfg.vision import Camera
from ballfg.vision.calibration.boards import Charuco, Chessboard, View

TRUE = Camera(
    name="left",
    size=(640, 480),
    matrix=[[600.0, 0, 328.0], [0, 606.0, 234.0], [0, 0, 1]],
    distortion=[-0.2, 0.05, 0.001, -0.002, 0.01],
    rvec=[0, 0, 0],
    tvec=[0, 0, 0],
)
CHESSBOARD = Chessboard(10, 7, 0.03)
CHARUCO = Charuco(8, 6, 0.04, 0.03)
DENSITY = 2000
"""px/m of the board's own image."""
MARGIN = 60
"""px of white paper around the squares."""
FINER = 2
"""Rays across a pixel, along u and v each."""


@lru_cache
def print_of(board: Chessboard | Charuco) -> np.ndarray:
    """The board on paper, `DENSITY` px/m, its first square at (MARGIN, MARGIN)."""
    side = round(board.square * DENSITY)
    if isinstance(board, Charuco):
        inner = board.board.generateImage((board.columns * side, board.rows * side), marginSize=0)
    else:
        dark = np.add.outer(np.arange(board.rows), np.arange(board.columns)) % 2 == 0
        inner = np.kron(np.where(dark, 0, 255), np.ones((side, side))).astype(np.uint8)
    return np.pad(inner, MARGIN, constant_values=255)


@lru_cache
def _plane(camera: Camera) -> np.ndarray:
    width, height = camera.size
    u, v = (np.arange(FINER * side) + 0.5 for side in (width, height))
    plane = camera.normalized(np.stack(np.meshgrid(u / FINER - 0.5, v / FINER - 0.5), axis=-1))
    return np.concatenate((plane, np.ones((*plane.shape[:2], 1))), axis=-1)


def image_of(
    board: Chessboard | Charuco, rvec: np.ndarray, tvec: np.ndarray, rng: np.random.Generator, camera: Camera = TRUE
) -> np.ndarray:
    """(h, w) uint8: area of the board in each pixel, blur of 0.6 px, noise of 2 grey values."""
    rotation = cv2.Rodrigues(rvec)[0]
    on_board = _plane(camera) @ np.linalg.inv(np.column_stack((rotation[:, :2], tvec))).T
    places = (on_board[..., :2] / on_board[..., 2:] * DENSITY + MARGIN - 0.5).astype(np.float32)
    paper = print_of(board)
    fine = cv2.remap(paper, places[..., 0].copy(), places[..., 1].copy(), cv2.INTER_LINEAR, borderValue=120)
    image = cv2.resize(fine.astype(np.float32), camera.size, interpolation=cv2.INTER_AREA)
    image = 20 + 0.8 * cv2.GaussianBlur(image, (0, 0), 0.6)
    return np.clip(image + rng.normal(0, 2.0, image.shape), 0, 255).round().astype(np.uint8)


def poses(
    board: Chessboard | Charuco,
    n: int,
    rng: np.random.Generator,
    tilt: float = 0.6,
    lean: float = 0.0,
    reach: float = 1.0,
    near: float = 0.5,
) -> list:
    """Poses (rvec, tvec) of boards, turned by up to `tilt` rad to all sides about a common `lean`.

    They are `near` m away and up to 1.3 times that. Their middles are in that of the image and, two in three, towards
    its corners; of reach 1 all lie in the image.
    """
    made = []
    for i in range(n):
        rvec = np.array([lean + rng.uniform(-tilt, tilt), rng.uniform(-tilt, tilt), rng.uniform(-0.3, 0.3)])
        z = rng.uniform(near, 1.3 * near)
        corner = np.array([(i % 2) - 0.5, (i // 2 % 2) - 0.5]) if i % 3 else np.zeros(2)
        middle = z * np.array([0.35 * reach * corner[0], 0.25 * reach * corner[1], 1.0])
        rotation = cv2.Rodrigues(rvec)[0]
        made.append((rvec, middle - rotation @ (np.array([board.columns, board.rows, 0]) * board.square / 2)))
    return made


def exact_views(
    n: int, rng: np.random.Generator, noise: float = 0.1, camera: Camera = TRUE, reach: float = 1.7, **turned: float
) -> list[View]:
    """Views of a chessboard without images: corners that lie in it, where they are projected, with normal noise, px."""
    board = CHESSBOARD
    places = np.stack(np.meshgrid(np.arange(1, board.columns), np.arange(1, board.rows)), axis=-1).reshape(-1, 2)
    points = np.column_stack((board.square * places, np.zeros(len(places))))
    views = []
    for i, (rvec, tvec) in enumerate(poses(board, n, rng, reach=reach, **turned)):
        pixels = cv2.projectPoints(points, rvec, tvec, camera.matrix, camera.distortion)[0].reshape(-1, 2)
        pixels += rng.normal(0, noise, pixels.shape)
        seen = ((pixels >= 0) & (pixels < np.array(camera.size) - 1)).all(axis=1)
        views.append(View(f"{i:02d}.png", camera.size, pixels[seen], points[seen]))
    return views
