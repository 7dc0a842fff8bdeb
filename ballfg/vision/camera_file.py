"""Cameras in files: `cameras.yaml`, and the files that OpenCV's FileStorage writes."""

from collections.abc import Iterable
from numbers import Integral
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from ballfg.checks import check_keys, is_number
from ballfg.files.strict_yaml import mapping, read_mapping
from ballfg.files.whole_file import write_text
from ballfg.vision.camera import Camera
from ballfg.vision.camera_storage import check_names, is_storage, read_storage

CAMERAS_FILE: Final = "cameras.yaml"
"""Its name in the folder of a dataset or a scene."""
LENS: Final = ("size", "matrix", "distortion")
POSE: Final = ("rvec", "tvec")
FIELDS: Final = (*LENS, *POSE, "time_offset")
"""Fields of a camera in the file, in the order in which they are written; docs/calibrate.md says what they mean."""


def read_cameras(path: str | PathLike[str], *, posed: bool = True) -> list[Camera]:
    """The cameras of a file, in its order.

    Args:
        path: our YAML, or a FileStorage file of OpenCV (`.xml`, `.json`, or YAML that begins with `%YAML`) with one
            camera (named as the file) or a map for each.
        posed: False: `rvec` and `tvec` may be missing; the camera then stands at the world's origin, unturned.
    Raises:
        FileNotFoundError: there is no such file.
        ValueError, TypeError: a field that is missing, not known or wrong; the message names file, camera and field.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: must be a file with cameras; there is none. Correct the path.")
    try:
        if is_storage(path):
            cameras = read_storage(path)
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
    cameras = check_names(cameras)
    fields = FIELDS if posed else (*LENS, "time_offset")
    plain = {
        camera.name: {field: np.asarray(getattr(camera, field)).tolist() for field in fields} for camera in cameras
    }
    text = yaml.safe_dump({"cameras": plain}, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120)
    write_text(path, text)


def _camera(name: str, content: Any, posed: bool) -> Camera:
    """A camera from its fields. Raises: ValueError, TypeError: names camera and field."""
    where = f"camera {name!r}"
    fields = mapping(where, content)
    check_keys(where, fields, FIELDS, LENS)
    missing = [field for field in POSE if fields.get(field) is None]
    if missing and (posed or len(missing) == 1):
        raise ValueError(
            f"{where}: field {missing[0]!r} is required; got {', '.join(fields)}. "
            "Add it, or let 'ballfg calibrate-cameras --intrinsics FILE --table TABLE' find where the camera stands."
        )
    size, offset = fields["size"], fields.get("time_offset", 0.0)
    if not (isinstance(size, list | tuple) and len(size) == 2 and all(_is_whole(side) for side in size)):
        raise ValueError(f"{where}: size must be width and height in pixels, as [1280, 720]; got {size!r}. Correct it.")
    if not is_number(offset):
        raise ValueError(f"{where}: time_offset must be a number in s; got {offset!r}. Write it like 0.004 or 4.0e-3.")
    return Camera(
        name=name,
        size=(size[0], size[1]),
        matrix=fields["matrix"],
        distortion=fields["distortion"],
        rvec=np.zeros(3) if missing else fields["rvec"],
        tvec=np.zeros(3) if missing else fields["tvec"],
        time_offset=offset,
    )


def _is_whole(value: object) -> bool:
    return is_number(value) and isinstance(value, Integral)
