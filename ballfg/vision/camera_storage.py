"""Cameras in the files of OpenCV's FileStorage: XML, JSON, and YAML with types that other readers do not know."""

from collections import Counter
from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from ballfg.checks import did_you_mean
from ballfg.files.whole_file import whole_file
from ballfg.vision.camera import Camera

MATRIX: Final = "camera_matrix"
NODES: Final = {
    "matrix": (MATRIX,),
    "distortion": ("distortion_coefficients", "dist_coeffs"),
    "rvec": ("rvec",),
    "tvec": ("tvec",),
}
"""Our name of an array -> OpenCV's names of its node, the one that is written first; others are read."""
ENDINGS: Final = (".xml", ".json", ".yml", ".yaml")


def is_storage(path: Path) -> bool:
    """Whether a file is one of FileStorage's: .xml, .json, or YAML that begins with a %YAML line."""
    if path.suffix.lower() in (".xml", ".json"):
        return True
    with path.open("rb") as file:
        return file.read(8).removeprefix(b"\xef\xbb\xbf").startswith(b"%YAML")


def read_storage(path: Path) -> dict[str, dict[str, Any]]:
    """Name of each camera -> its fields as in `cameras.yaml`; nodes that say nothing about a camera are left aside.

    A file with `camera_matrix` at its top holds one camera, named as the file; otherwise every map with that node is
    a camera.

    Raises: ValueError: not readable, or without cameras; the message names file, camera and node.
    """
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError):  # the binding raises the latter where the constructor throws
        raise ValueError(f"{path}: must be a file of OpenCV's FileStorage; it cannot be parsed. Correct it.") from None
    try:
        root = storage.root()
        keys = _keys(root)
        if MATRIX in keys:
            return {path.stem: _fields(root, str(path))}
        found = {key: root.getNode(key) for key in keys}
        cameras = {key: node for key, node in found.items() if MATRIX in _keys(node)}
        if not cameras:
            got = ", ".join(keys) or "nothing"
            hint = did_you_mean(MATRIX, keys).replace("Did you mean", "Rename")
            raise ValueError(f"{path}: node {MATRIX!r} is required; got {got}.{hint} Add it.")
        return {key: _fields(node, f"{path}: camera {key!r}") for key, node in cameras.items()}
    finally:
        storage.release()


def write_opencv(path: str | PathLike[str], cameras: Iterable[Camera], *, posed: bool = True) -> None:
    """Writes cameras with OpenCV's FileStorage, a map for each; floats read back bit for bit. Never leaves half a file.

    Args: path: .xml, .json, .yml or .yaml.  posed: False: without `rvec` and `tvec`.
    Raises: ValueError: another ending, no cameras, a name twice, or one that FileStorage cannot take.
        FileNotFoundError: the folder does not exist.
    """
    path = Path(path)
    if path.suffix.lower() not in ENDINGS:
        raise ValueError(f"path must end in {', '.join(ENDINGS)}; got {path}. Choose the format by the ending.")
    cameras = check_names(cameras)
    for camera in cameras:
        plain = camera.name.replace("_", "a").replace("-", "0")
        if not (plain.isascii() and plain.isalnum() and plain[0].isalpha()):
            raise ValueError(
                f"names of cameras must be letters, digits, - and _, a letter first, in OpenCV's files; "
                f"got {camera.name!r}. Rename it, or write cameras.yaml."
            )
    with whole_file(path) as temporary:
        storage = cv2.FileStorage(str(temporary), cv2.FILE_STORAGE_WRITE)
        for camera in cameras:
            storage.startWriteStruct(camera.name, cv2.FileNode_MAP)
            storage.write("image_width", camera.size[0])
            storage.write("image_height", camera.size[1])
            for field in NODES if posed else ("matrix", "distortion"):
                array = getattr(camera, field)
                storage.write(NODES[field][0], array if array.ndim == 2 else array[:, None])
            storage.write("time_offset", camera.time_offset)
            storage.endWriteStruct()
        storage.release()


def check_names(cameras: Iterable[Camera]) -> Sequence[Camera]:
    """The cameras. Raises: ValueError: if there are none, or two of one name."""
    cameras = list(cameras)
    if not cameras:
        raise ValueError("cameras must hold at least one camera; got none. Pass the cameras to write.")
    name, count = Counter(camera.name for camera in cameras).most_common(1)[0]
    if count > 1:
        raise ValueError(f"cameras must have names of their own; got {name!r} {count} times. Rename them.")
    return cameras


def _fields(node: cv2.FileNode, where: str) -> dict[str, Any]:
    fields: dict[str, Any] = {"size": _size(node, where)}
    for field, names in NODES.items():
        present = [name for name in names if name in _keys(node)]
        if present:
            fields[field] = _array(node.getNode(present[0]), f"{where}: node {present[0]!r}")
    if "time_offset" in _keys(node):
        offset = node.getNode("time_offset")
        if not (offset.isReal() or offset.isInt()):
            raise ValueError(f"{where}: node 'time_offset' must be a number in s. Correct it.")
        fields["time_offset"] = offset.real()
    return fields


def _size(node: cv2.FileNode, where: str) -> list[int]:
    keys = _keys(node)
    if "image_size" in keys:
        numbers = np.ravel(_array(node.getNode("image_size"), f"{where}: node 'image_size'"))
    elif "image_width" in keys and "image_height" in keys:
        numbers = np.array([node.getNode(name).real() for name in ("image_width", "image_height")])
    else:
        raise ValueError(
            f"{where}: nodes 'image_width' and 'image_height' are required; got {', '.join(keys)}. Add them."
        )
    if len(numbers) != 2 or (numbers != np.trunc(numbers)).any():
        raise ValueError(f"{where}: the image's size must be two whole numbers; got {numbers.tolist()}. Correct it.")
    return [int(number) for number in numbers]


def _array(node: cv2.FileNode, where: str) -> list[float] | list[list[float]]:
    """The numbers of a matrix or a sequence, flat unless it is a matrix of several rows and columns."""
    if node.isSeq():
        items = [node.at(i) for i in range(node.size())]
        if all(item.isReal() or item.isInt() for item in items):
            return [item.real() for item in items]
    elif node.isMap():
        matrix = node.mat()
        if matrix is None:  # how an empty matrix comes back
            return []
        flat = matrix.ndim < 2 or 1 in matrix.shape[:2]
        return list(map(float, matrix.ravel())) if flat else matrix.astype(float).tolist()
    raise ValueError(f"{where} must be a matrix or a list of numbers. Correct it.")


def _keys(node: cv2.FileNode) -> tuple[str, ...]:
    return tuple(node.keys()) if node.isMap() else ()
