"""Turns the videos of a rig into balls: detections, tracks, the agreement of the cameras, and a summary."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.checks import did_you_mean, listed, shown
from ballfg.progress import Watch, unwatched
from ballfg.tracks import Track
from ballfg.tracks.checks import check_overlap
from ballfg.vision.association.agreement import LEAST_MISFIT, Agreement, check_agreement
from ballfg.vision.association.associate import AssociationSettings, associate
from ballfg.vision.association.gathering import SeenBall
from ballfg.vision.camera import Camera
from ballfg.vision.detection.detect import detect_all, learn_detector
from ballfg.vision.detection.detections import Detections, Detector
from ballfg.vision.detection.video import Video, open_video

FEWEST: Final = 2  # least number of cameras: candidates of a single one agree with nothing
DIGITS: Final = 3  # least number of digits in a track's name: names then sort as their tracks do


@dataclass(frozen=True, eq=False)
class Tracking:
    """The balls of a recording."""

    cameras: tuple[Camera, ...]  # the rig
    detections: tuple[Detections, ...]  # all candidates of each camera, in the order of `cameras`
    balls: tuple[SeenBall, ...]  # in the order of their first points
    agreement: Agreement | None  # the agreement of the cameras; None without a ball
    bounces: Mapping[str, Array] = field(default_factory=dict)
    """Of each track that bounces: (k, 6) m, places of the ball's centre and their standard deviations."""

    @property
    def names(self) -> list[str]:
        """The names of the tracks: 000, 001, ..."""
        digits = max(DIGITS, len(str(len(self.balls))))
        return [f"{number:0{digits}d}" for number in range(len(self.balls))]

    @property
    def tracks(self) -> list[Track]:
        """The balls' points with their standard deviations."""
        return [
            Track(ball.times, ball.points, np.sqrt(np.diagonal(ball.covariances, axis1=1, axis2=2)), name=name)
            for name, ball in zip(self.names, self.balls, strict=True)
        ]

    @property
    def rate(self) -> float | None:
        """Points per second of the balls, of one camera its sightings, Hz, to six digits; None without a ball."""
        if not self.balls:
            return None
        alone = len(self.cameras) == 1  # whose states may be those at both ends of each exposure
        times = [ball.sightings.times if alone else ball.times for ball in self.balls]
        step = float(np.median(np.concatenate([np.diff(one) for one in times])))
        return float(f"{1.0 / step:.6g}")

    def seen(self, ball: SeenBall, camera: int) -> tuple[Index, Array]:
        """The frames (m,) in which a camera, by its number, saw one of `balls`, increasing, and its pixels (m, 2)."""
        rows = ball.sightings.camera == camera
        frames = np.searchsorted(self.detections[camera].frames, ball.sightings.times[rows])
        return frames.astype(np.int64), ball.sightings.pixels[rows]

    def rows(self, ball: SeenBall, camera: int) -> Index:
        """(m,) numbers of the candidates of a camera, by its number, that are sightings of one of `balls`."""
        detections, (frames, pixels) = self.detections[camera], self.seen(ball, camera)
        first, end = (np.searchsorted(detections.frame, frames, side) for side in ("left", "right"))
        found = [
            low + int(np.argmin(np.abs(detections.pixels[low:high] - pixel).sum(axis=1)))
            for low, high, pixel in zip(first.tolist(), end.tolist(), pixels, strict=True)
        ]
        return np.array(found, dtype=np.int64)


def track_videos(
    videos: Mapping[str, Path],
    cameras: Sequence[Camera],
    make: Callable[[Video], Detector] = learn_detector,
    *,
    stamps: Mapping[str, Path] | None = None,
    settings: AssociationSettings | None = None,
    jobs: int = 1,
    watch: Watch = unwatched,
) -> Tracking:
    """Balls from the videos of a rig.

    Args:
        videos: camera -> file or folder of images, for each of the cameras.
        cameras: at least two, calibrated at the videos' sizes.
        make: the detector of a camera, from its opened video.
        stamps: camera -> CSV file, for those whose stamps are not the container's.
        watch: sees the numbers of the frames that are searched.
    Raises: FileNotFoundError: a file is missing. ValueError: as `open_video`, `check_sizes` and `track_detections`.
    """
    check_rig(cameras)
    found = detect_videos(videos, cameras, make, stamps=stamps, jobs=jobs, watch=watch)
    return track_detections(found, cameras, settings)


def detect_videos(
    videos: Mapping[str, Path],
    cameras: Sequence[Camera],
    make: Callable[[Video], Detector] = learn_detector,
    *,
    stamps: Mapping[str, Path] | None = None,
    jobs: int = 1,
    watch: Watch = unwatched,
) -> list[Detections]:
    """The candidates in the videos of one or more cameras; arguments and errors as of `track_videos`."""
    check_sizes({name: open_video(path, (stamps or {}).get(name)).size for name, path in videos.items()}, cameras)
    return list(detect_all(videos, make, stamps=stamps, jobs=jobs, watch=watch).values())


def track_detections(
    detections: Sequence[Detections], cameras: Sequence[Camera], settings: AssociationSettings | None = None
) -> Tracking:
    """Balls from the candidates of a rig.

    Args: detections: one for each of the cameras, in any order.  cameras: at least two, with names of their own.
    Raises: ValueError: a camera without detections or detections without a camera, too few cameras, or recordings
        that do not overlap in time.
    """
    check_rig(cameras)
    by_name = {seen.camera: seen for seen in detections}
    wanted, given = sorted(camera.name for camera in cameras), sorted(seen.camera for seen in detections)
    if wanted != given or len(set(wanted)) < len(wanted):
        raise ValueError(f"detections must be one for each camera; got {given} for {wanted}. Match their names.")
    ordered = tuple(by_name[camera.name] for camera in cameras)
    pairs = [(seen.frames - camera.time_offset, camera) for seen, camera in zip(ordered, cameras, strict=True)]
    check_overlap({camera.name: (float(t[0]), float(t[-1])) for t, camera in pairs if len(t)})
    balls = tuple(associate(ordered, cameras, settings))
    return Tracking(tuple(cameras), ordered, balls, check_agreement(balls, cameras) if balls else None)


def check_rig(cameras: Sequence[Camera]) -> None:
    """Refuses too few cameras. Raises: ValueError."""
    if len(cameras) < FEWEST:
        raise ValueError(
            f"cameras must be at least {FEWEST}; got {len(cameras)}. For one camera run 'ballfg track', or "
            "track_one_camera of ballfg.estimation.one_camera."
        )


def summary(tracking: Tracking) -> Iterator[str]:
    """Lines: the detections of each camera, and their use."""
    for number, (camera, seen) in enumerate(zip(tracking.cameras, tracking.detections, strict=True)):
        used = sum(int((ball.sightings.camera == number).sum()) for ball in tracking.balls)
        yield f"  {camera.name}: {len(seen.frames)} frames, {len(seen)} candidates, {used} of them a ball"


def blind_cameras(tracking: Tracking) -> Iterator[str]:
    """A sentence for each camera without a part in any ball, if there are balls."""
    for number, camera in enumerate(tracking.cameras):
        if tracking.balls and not any((ball.sightings.camera == number).any() for ball in tracking.balls):
            yield f"camera {shown(camera.name)} saw none of the balls. Check its stamps, its pose and its candidates."


def uncertain_cameras(tracking: Tracking) -> Iterator[str]:
    """A sentence if cameras have a covariance: it is in that of each point, but moves all points of a track alike."""
    loose = [camera.name for camera in tracking.cameras if camera.covariance is not None]
    if loose and len(tracking.cameras) > 1 and tracking.balls:
        yield (
            f"errors of cameras known roughly ({listed(loose)}) last in tracks.csv: estimates from it are too sure. "
            "Use --from detections, which takes in the cameras' covariance."
        )


def disagreement(tracking: Tracking) -> str | None:
    """A sentence on the calibration; None if the cameras agree or too little was seen."""
    found = tracking.agreement
    return found.sentence if found and (found.culprit is not None or found.misfit > LEAST_MISFIT) else None


def no_ball(tracking: Tracking) -> str:
    """One sentence with the best scores of each camera, for a recording in which no ball was found."""
    best = "; ".join(
        f"{seen.camera}: {', '.join(f'{score:.2f}' for score in seen.best_scores()) or 'no candidate'}"
        f" in {len(seen.frames)} frames"
        for seen in tracking.detections
    )
    return f"no ball was found. Best candidates' scores (1 is a ball): {best}."


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
