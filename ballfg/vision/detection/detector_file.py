"""A detector of one's own, from a Python file."""

from collections.abc import Callable
from functools import partial
from itertools import count
from pathlib import Path

from ballfg.checks import did_you_mean
from ballfg.files.python_file import blamed, run_file
from ballfg.vision.arrays import Image
from ballfg.vision.detection.detections import Candidates, Detector
from ballfg.vision.detection.video import Video

Maker = Callable[[Video], Detector]
"""Makes the detector of a camera from its video."""


def load_detector(text: str) -> Maker:
    """Runs a Python file and takes a detector from it: a function of an image, or a class of such things.

    Args: text: `FILE.py:NAME`; the file is one that you trust: all of its code runs.
    Returns: what makes the detector of a camera, fit to be sent to other processes: the function as it is, or an
        instance of the class, made without arguments.
    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a text of another form, a file that does not run, or a name that is no callable of it.
    """
    file, colon, name = text.rpartition(":")
    if not (colon and file and name.isidentifier()):
        raise ValueError(f"detector must be FILE.py:NAME; got {text!r}. Name the callable after a colon.")
    path = Path(file).resolve()
    if not path.is_file():
        raise FileNotFoundError(f"detector: {path} does not exist. A detector of one's own is one Python file.")
    found = vars(run_file(path, "detector"))
    if not callable(found.get(name)):
        own = [word for word, item in found.items() if callable(item) and not word.startswith("_")]
        problem = "is not callable" if name in found else "is not defined there"
        raise ValueError(
            f"{path} must define the callable {name!r}; it {problem}. Correct the name.{did_you_mean(name, own)}"
        )
    return partial(_made, found[name], path)


def _made(found: Detector | type[Detector], path: Path, video: Video) -> Detector:
    """The detector of a camera, which serves no other; what it raises is told with file, line, video and frame."""
    with blamed(path, f"making the detector of {video.name}"):
        detector = found() if isinstance(found, type) else found
    frames = count()

    def watched(image: Image) -> Candidates:
        with blamed(path, f"frame {next(frames)} of {video.name}"):
            return detector(image)

    return watched
