"""Runs detectors, ballfg's or a user's, over videos, one after the other or each in its process."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import count
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Final, TypeVar

import cv2

from ballfg.checks import did_you_mean, shown
from ballfg.files.python_file import blamed, run_file
from ballfg.parallel.executor import Pending
from ballfg.parallel.processes import Processes
from ballfg.parallel.worker import tell
from ballfg.progress import Watch, unwatched
from ballfg.vision.arrays import Image
from ballfg.vision.detection.background import FEWEST
from ballfg.vision.detection.detections import Candidates, Detections, Detector
from ballfg.vision.detection.detector import BallDetector, DetectorSettings
from ballfg.vision.detection.video import Video, open_video

T = TypeVar("T")

Maker = Callable[[Video], Detector]  # makes the detector of a camera from its video
SAMPLE: Final = 15  # number of frames for a background: objects at the same place in eight of them are background
LOOKS: Final = 0.05  # s without a message after which the processes are checked
TELLS: Final = 20  # number of frames between progress messages of a process
SEARCHED: Final = "frames searched"


def learn_detector(video: Video, settings: DetectorSettings | None = None) -> BallDetector:
    """The detector of a video's camera: its background learned from frames spread over the recording.

    Args: video: of the camera.  settings: what is known about the ball; the default ones if None.
    Returns: the detector.
    Raises: ValueError: fewer than three frames.
    """
    images = video.sample(SAMPLE)
    if len(images) < FEWEST:
        rule = f"video {shown(video.name)} must have at least {FEWEST} frames to learn a background"
        raise ValueError(f"{rule}; got {len(images)}. Record longer, or leave the camera out.")
    return BallDetector(images, settings)


def load_detector(text: str) -> Maker:
    """Runs a Python file and takes a detector from it: a function of an image, or a class of such things.

    Args: text: `FILE.py:NAME`; the file is one that you trust: all of its code runs.
    Returns: what makes the detector of a camera, fit to be sent to other processes: the function as it is, or an
        instance of the class, made without arguments.
    Raises: FileNotFoundError: there is no such file. ValueError: a text of another form, a file that does not run, or a
        name that is no callable of it.
    """
    file, colon, name = text.rpartition(":")
    if not (colon and file and name.isidentifier()):
        raise ValueError(f"detector must be FILE.py:NAME; got {shown(text)}. Name the callable after a colon.")
    path = Path(file).resolve()
    if not path.is_file():
        raise FileNotFoundError(f"detector: {path} does not exist. A detector of one's own is one Python file.")
    found = vars(run_file(path, "detector"))
    if not callable(found.get(name)):
        own = [word for word, item in found.items() if callable(item) and not word.startswith("_")]
        problem = "is not callable" if name in found else "is not defined there"
        raise ValueError(
            f"{path} must define the callable {shown(name)}; it {problem}. Correct the name.{did_you_mean(name, own)}"
        )
    return partial(_made, found[name], path)


def detect(video: Video, camera: str, detector: Detector, watch: Watch = unwatched) -> Detections:
    """All candidates of a video.

    Args: detector: called with each frame in order; for instance `learn_detector(video)`, or one of your own.
        watch: sees the numbers of the frames that are done.
    Raises: ValueError: a video that turns out unreadable, see `Video.frames`. TypeError: a detector that does not give
        `Candidates`.
    """
    seen: list[tuple[float, Candidates]] = []
    deque(watch(_run(video, detector, seen), video.count, SEARCHED), maxlen=0)
    return Detections.of_frames(camera, seen)


def detect_all(
    videos: Mapping[str, Path],
    make: Maker = learn_detector,
    *,
    stamps: Mapping[str, Path] | None = None,
    jobs: int = 1,
    watch: Watch = unwatched,
) -> dict[str, Detections]:
    """All candidates of several cameras' videos.

    Args:
        videos: camera -> file or folder.
        make: the detector of an opened video; called in the process that runs it.
        stamps: camera -> CSV file, for those whose stamps are not the container's.
        jobs: processes; no more than cameras are of use.
        watch: sees the numbers of the frames that are done, those of all cameras together.
    Raises: TypeError, ValueError, FileNotFoundError: as `open_video` and `detect`.
    """
    opened = {name: open_video(path, (stamps or {}).get(name)) for name, path in videos.items()}
    total = sum(video.count for video in opened.values())
    if jobs == 1 or len(opened) < 2:
        seen: dict[str, list[tuple[float, Candidates]]] = {name: [] for name in opened}
        steps = (step for name, video in opened.items() for step in _run(video, make(video), seen[name]))
        deque(watch(steps, total, SEARCHED), maxlen=0)
        return {name: Detections.of_frames(name, frames) for name, frames in seen.items()}
    others, told = Processes(min(jobs, len(opened)), helped=False), SimpleQueue[int]()
    send = others.sender(_job, told.put)
    running = {name: send([(video, name, make)]) for name, video in opened.items()}
    try:
        deque(watch(_told(told, running.values()), total, SEARCHED), maxlen=0)
        return {name: job.result() for name, job in running.items()}
    except BaseException:
        others.stop()  # what the other cameras see is of no use any more
        raise


def _job(chunk: Sequence[tuple[Video, str, Maker]]) -> Detections:
    """Detects in one camera's video in a process of its own, and reports the number of finished frames."""
    cv2.setNumThreads(1)
    ((video, camera, make),) = chunk
    return detect(video, camera, make(video), _telling)


def _telling(frames: Iterable[T], total: int, what: str) -> Iterator[T]:
    done = 0
    for done, frame in enumerate(frames, start=1):
        if done % TELLS == 0:
            tell(TELLS)
        yield frame
    tell(done % TELLS)


def _told(told: SimpleQueue[int], running: Iterable[Pending]) -> Iterator[int]:
    """Counts the frames that the processes say are done, until each has ended. Raises: what the first one raises."""
    number, left = 0, list(running)
    while left:
        try:
            done = told.get(timeout=LOOKS)
        except Empty:
            for job in [job for job in left if job.done()]:
                job.result()
                left.remove(job)
            continue
        yield from range(number, number + done)
        number += done


def _run(video: Video, detector: Detector, seen: list[tuple[float, Candidates]]) -> Iterator[int]:
    """Collects stamps and candidates; yields the number of each frame that is done."""
    for number, (stamp, image) in enumerate(video.frames()):
        candidates = detector(image)
        if not isinstance(candidates, Candidates):
            problem = f"a detector must return Candidates; got {type(candidates).__name__} for frame {number}"
            raise TypeError(f"{problem}. Make them with Candidates.at(pixels, sigma).")
        seen.append((stamp, candidates))
        yield number


def _made(found: Detector | type[Detector], path: Path, video: Video) -> Detector:
    """The detector of a single camera; its errors are reported with file, line, video and frame."""
    with blamed(path, f"making the detector of {video.name}"):
        detector = found() if isinstance(found, type) else found
    frames = count()

    def watched(image: Image) -> Candidates:
        with blamed(path, f"frame {next(frames)} of {video.name}"):
            return detector(image)

    return watched
