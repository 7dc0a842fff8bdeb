"""Reads and writes cameras: `cameras.yaml`, and the files of OpenCV's FileStorage."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from numbers import Integral
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from ballfg.checks import check_keys, check_path, did_you_mean, is_number, listed, shown
from ballfg.files.file_storage import ENDINGS, Tree, number, numbers, read_storage
from ballfg.files.strict_yaml import mapping, read_mapping
from ballfg.files.whole_file import whole_file, write_text
from ballfg.tracks.checks import MAX_COORDINATE
from ballfg.vision.camera import Camera

CAMERAS_FILE: Final = "cameras.yaml"  # its name in the folder of a dataset or a scene
LENS: Final = ("size", "matrix", "distortion")
POSE: Final = ("rvec", "tvec")
CLOCK: Final = ("time_offset", "readout", "exposure")
FIELDS: Final = (*LENS, *POSE, *CLOCK, "covariance")  # in the file's order; docs/calibrate.md explains them
_MATRIX: Final = "camera_matrix"
_NODES: Final = {
    "matrix": (_MATRIX,),
    "distortion": ("distortion_coefficients", "dist_coeffs"),
    "rvec": ("rvec",),
    "tvec": ("tvec",),
}
"""This package's name of an array -> OpenCV's names of its node; the first is written, the others are read."""
_FISHEYE, _NO_FISHEYE = "fisheye_model", ("0", "false")
"""The node by which OpenCV's sample tells lenses of cv2.fisheye, whose four coefficients are others; what denies it."""
_MODEL, _OPENCVS_LENSES = "distortion_model", ("plumb_bob", "rational_polynomial")
"""The node by which ROS tells lenses apart, and its names of OpenCV's."""


def read_cameras(path: str | PathLike[str], *, posed: bool = True) -> list[Camera]:
    """The cameras of a file, in its order.

    Args:
        path: our YAML, or a FileStorage file of OpenCV (`.xml`, `.json`, or YAML that begins with `%YAML`) with one
            camera (named as the file) or a map for each.
        posed: False: `rvec` and `tvec` may be missing; the camera then stands at the world's origin, unturned.
    Raises: FileNotFoundError: there is no such file. ValueError, TypeError: a field that is missing, not known or
        wrong; the message names file, camera and field.
    """
    path = check_path("path", path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: must be a file with cameras; there is none. Correct the path.")
    try:
        with path.open("rb") as file:
            begins = file.read(8).removeprefix(b"\xef\xbb\xbf")
        if path.suffix.lower() in (".xml", ".json") or begins.startswith(b"%YAML"):
            cameras = _from_storage(path)
        else:
            content = read_mapping(path)
            check_keys(str(path), content, ("cameras",), ("cameras",))
            cameras = mapping("cameras", content["cameras"])
        return [_camera(name, fields, posed) for name, fields in cameras.items()]
    except (ValueError, TypeError) as error:
        text = str(error)
        rule = TypeError if isinstance(error, TypeError) else ValueError
        raise rule(text if text.startswith(str(path)) else f"{path}: {text}") from None


def write_cameras(path: str | PathLike[str], cameras: Iterable[Camera], *, posed: bool = True) -> None:
    """Writes `cameras.yaml`; floats read back bit for bit. Never leaves half a file.

    Args: path: ends in .yaml or .yml.  posed: False: without `rvec` and `tvec`, for cameras whose place is not known.
    Raises: ValueError: no cameras, two of one name, another ending. FileNotFoundError: the folder does not exist.
    """
    path = Path(path)
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise ValueError(f"path must end in .yaml; got {path}. Rename it; write_opencv writes .xml and .json.")
    cameras = _check_names(cameras)
    fields = FIELDS if posed else (*LENS, *CLOCK)
    plain = dict[str, dict[str, Any]]()
    for one in cameras:  # no covariance of an exact camera, no readout or exposure where it is not known
        absent = {"covariance": one.covariance is None, "readout": not one.readout, "exposure": not one.exposure}
        stated = [field for field in fields if not absent.get(field, False)]
        plain[one.name] = {field: np.asarray(getattr(one, field)).tolist() for field in stated}
    text = yaml.safe_dump({"cameras": plain}, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120)
    write_text(path, text)


def write_opencv(path: str | PathLike[str], cameras: Iterable[Camera], *, posed: bool = True) -> None:
    """Writes cameras with OpenCV's FileStorage, a map for each; floats read back bit for bit. Never leaves half a file.

    Args: path: .xml, .json, .yml or .yaml.  posed: False: without `rvec` and `tvec`.
    Raises: ValueError: another ending, no cameras, a name twice or one that FileStorage cannot take, a covariance.
        FileNotFoundError: the folder does not exist.
    """
    path = Path(path)
    if path.suffix.lower() not in ENDINGS:
        raise ValueError(f"path must end in {', '.join(ENDINGS)}; got {path}. Choose the format by the ending.")
    cameras = _check_names(cameras)
    for camera in cameras:
        if camera.covariance is not None:
            rule = f"cameras must be exact in OpenCV's files; {shown(camera.name)} has a covariance"
            raise ValueError(f"{rule}. Write cameras.yaml, or leave the covariance out.")
        plain = camera.name.replace("_", "a").replace("-", "0")
        if not (plain.isascii() and plain.isalnum() and plain[0].isalpha()):
            rule = "names of cameras must be letters, digits, - and _, a letter first, in OpenCV's files"
            raise ValueError(f"{rule}; got {shown(camera.name)}. Rename it, or write cameras.yaml.")
    import cv2  # reading takes none of it

    with whole_file(path) as temporary:
        storage = cv2.FileStorage(str(temporary), cv2.FILE_STORAGE_WRITE)
        for camera in cameras:
            storage.startWriteStruct(camera.name, cv2.FileNode_MAP)
            storage.write("image_width", camera.size[0])
            storage.write("image_height", camera.size[1])
            for field in _NODES if posed else ("matrix", "distortion"):
                array = getattr(camera, field)
                storage.write(_NODES[field][0], array if array.ndim == 2 else array[:, None])
            for field in CLOCK:
                storage.write(field, getattr(camera, field))
            storage.endWriteStruct()
        storage.release()


def _from_storage(path: Path) -> dict[str, dict[str, Any]]:
    """Name of each camera -> its fields as in `cameras.yaml`; unrelated nodes are ignored.

    A file with `camera_matrix` at its top holds one camera, named as the file; otherwise every map with that node is
    a camera.

    Raises: ValueError: not readable, or without cameras; the message names file, camera and node.
    """
    root = read_storage(path)
    if _MATRIX in root:
        return {path.stem: _fields(root, str(path))}
    cameras = {key: node for key, node in root.items() if isinstance(node, dict) and _MATRIX in node}
    if not cameras:
        hint = did_you_mean(_MATRIX, root).replace("Did you mean", "Rename")
        raise ValueError(f"{path}: node {_MATRIX!r} is required; got {listed(root)}.{hint} Add it.")
    return {key: _fields(node, f"{path}: camera {shown(key)}") for key, node in cameras.items()}


def _check_names(cameras: Iterable[Camera]) -> Sequence[Camera]:
    cameras = list(cameras)
    if not cameras:
        raise ValueError("cameras must hold at least one camera; got none. Pass the cameras to write.")
    name, count = Counter(camera.name for camera in cameras).most_common(1)[0]
    if count > 1:
        raise ValueError(f"cameras must have names of their own; got {shown(name)} {count} times. Rename them.")
    return cameras


def _camera(name: str, content: Any, posed: bool) -> Camera:
    where = f"camera {shown(name)}"
    fields = mapping(where, content)
    check_keys(where, fields, FIELDS, LENS)
    missing = [field for field in POSE if fields.get(field) is None]
    if missing and (posed or len(missing) == 1):
        raise ValueError(
            f"{where}: field {missing[0]!r} is required; got {listed(fields)}. "
            "Add it, or let 'ballfg calibrate-cameras --intrinsics FILE --table TABLE' find where the camera stands."
        )
    size, clock = fields["size"], {field: fields.get(field, 0.0) for field in CLOCK}
    sides = size if isinstance(size, list | tuple) else ()
    if len(sides) != 2 or not all(is_number(side) and isinstance(side, Integral) for side in sides):
        what = f"{where}: size must be width and height in pixels, as [1280, 720]; got {shown(size)}"
        raise ValueError(f"{what}. Correct it.")
    for field, value in clock.items():
        if not is_number(value):
            what = f"{where}: {field} must be a number in s; got {shown(value)}"
            raise ValueError(f"{what}. Write it like 0.004 or 4.0e-3.")
    rvec, tvec = (np.zeros(3) if missing else fields[field] for field in POSE)
    own = ((sides[0], sides[1]), fields["matrix"], fields["distortion"], rvec, tvec)
    camera = Camera(name, *own, covariance=fields.get("covariance"), **clock)
    if (away := float(np.linalg.norm(camera.tvec))) > MAX_COORDINATE:
        what = f"{where}: tvec must be in m, at most {MAX_COORDINATE:g} m long; got {away:.4g}"
        raise ValueError(f"{what}. It is probably in mm, as after squares in mm: divide by 1000.")
    return camera


def _check_lens(node: Mapping[str, Tree], where: str) -> None:
    """Refuses coefficients that a file says are of another model than `Camera`'s. Raises: ValueError."""
    stated, fisheye = node.get(_MODEL, "plumb_bob"), node.get(_FISHEYE, "0")
    for name, value, fine in ((_FISHEYE, fisheye, _NO_FISHEYE), (_MODEL, stated, _OPENCVS_LENSES)):
        if str(value).lower() not in fine:
            rule = f"{where}: node {name!r} must be one of {', '.join(fine)}; got {shown(value)}"
            raise ValueError(f"{rule}. Its coefficients mean something else: calibrate with --distortion 8.")


def _fields(node: Mapping[str, Tree], where: str) -> dict[str, Any]:
    _check_lens(node, where)
    if "image_size" in node:
        sides = np.ravel(numbers(node["image_size"], f"{where}: node 'image_size'"))
    elif "image_width" in node and "image_height" in node:
        sides = np.array([number(node[name], f"{where}: node {name!r}") for name in ("image_width", "image_height")])
    else:
        raise ValueError(f"{where}: nodes 'image_width' and 'image_height' are required; got {listed(node)}. Add them.")
    if len(sides) != 2 or not np.isfinite(sides).all() or (sides != np.trunc(sides)).any():
        got = shown(sides.tolist())
        raise ValueError(f"{where}: the image's size must be two whole numbers; got {got}. Correct it.")
    fields: dict[str, Any] = {"size": [int(side) for side in sides]}
    for field, names in _NODES.items():
        present = [name for name in names if name in node]
        if present:
            fields[field] = numbers(node[present[0]], f"{where}: node {present[0]!r}")
    for field in CLOCK:
        if field in node:
            fields[field] = number(node[field], f"{where}: node {field!r}")
    return fields
