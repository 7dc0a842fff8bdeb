"""Matches videos to the cameras of a rig and checks their sizes."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from ballfg.checks import did_you_mean, listed, shown
from ballfg.vision.camera import Camera

SAME_SHAPE: Final = 0.01  # largest relative difference between the proportions of a scaled video and its camera's


def match_videos(given: Sequence[str], cameras: Sequence[Camera], ignored: Sequence[str] = ()) -> dict[str, Path]:
    """The video of each camera.

    Args: given: paths, each with a camera's name as its stem, or `name=path`.
        ignored: names of cameras whose videos are passed over.
    Returns: camera -> path, in the order of the cameras.
    Raises: ValueError: a video of no camera, two of one, or a camera without one.
    """
    names = [camera.name for camera in cameras]
    found: dict[str, Path] = {}
    for text in given:
        name, path = named_path(text, [*names, *ignored])
        if name in ignored:
            continue
        if name not in names:
            problem = f"video {shown(text)} must be of a camera: {listed(names)}; got {shown(name)}"
            raise ValueError(f"{problem}. Rename it, or write NAME={path}.{did_you_mean(name, names)}")
        if name in found:
            both = f"{found[name]} and {path}"
            raise ValueError(f"camera {shown(name)} must have one video; got {both}. Drop one of them.")
        found[name] = path
    missing = [name for name in names if name not in found]
    if missing:
        raise ValueError(
            f"every camera must have a video; got none for {' and '.join(map(shown, missing))}. "
            f"Give it as {missing[0]}=FILE, or leave the camera out with --without {missing[0]}."
        )
    return {name: found[name] for name in names}


def named_path(text: str, names: Sequence[str]) -> tuple[str, Path]:
    """The name and the path in a command-line argument: `name=path`, or a path with the name as its stem."""
    name, equals, rest = text.partition("=")
    if equals and rest and (name in names or not Path(text).exists()):
        return name, Path(rest)
    path = Path(text)
    return (path.name if path.is_dir() else path.stem), path


def stamp_files(given: Sequence[str], cameras: Sequence[Camera]) -> dict[str, Path]:
    """The files of stamps of cameras, given as `name=path`. Raises: ValueError: no name, no camera's, or twice."""
    names = [camera.name for camera in cameras]
    found: dict[str, Path] = {}
    for text in given:
        name, equals, path = text.partition("=")
        if not (equals and path):
            raise ValueError(f"stamps must be NAME=FILE; got {shown(text)}. Put the camera's name before the file.")
        if name not in names or name in found:
            problem = "is given twice" if name in found else "is no camera's"
            raise ValueError(f"stamps must be one file a camera; {shown(name)} {problem}. Cameras: {listed(names)}.")
        found[name] = Path(path)
    return found


def without(cameras: Sequence[Camera], names: Sequence[str]) -> list[Camera]:
    """The remaining cameras. Raises: ValueError: a name of no camera."""
    known = [camera.name for camera in cameras]
    for name in names:
        if name not in known:
            hint = did_you_mean(name, known)
            raise ValueError(f"without must name a camera: {listed(known)}; got {shown(name)}. Correct it.{hint}")
    return [camera for camera in cameras if camera.name not in names]


def check_sizes(sizes: Mapping[str, tuple[int, int]], cameras: Sequence[Camera]) -> None:
    """Refuses a calibration of another resolution than the videos' (px). Raises: ValueError: with both sizes."""
    for camera in cameras:
        (width, height), (old_width, old_height) = sizes[camera.name], camera.size
        if (width, height) == camera.size:
            continue
        across = width / old_width
        remedy = (
            f"If the whole picture was scaled, set size to [{width}, {height}] and multiply fx, fy by {across:.6g}; "
            f"cx, cy become {across:.6g} (c + 0.5) - 0.5. If it was cropped, calibrate again."
        )
        if abs(across / (height / old_height) - 1.0) > SAME_SHAPE:
            remedy = "Calibrate it again at that size: the pictures have different proportions."
        raise ValueError(
            f"camera {shown(camera.name)} must be calibrated at the size of its video; got {old_width}x{old_height} in "
            f"the cameras' file and a video of {width}x{height}. {remedy}"
        )
