"""Names the files of a rally before a moving camera, so that a command knows one without the estimation of it."""

from pathlib import Path
from typing import Final

from ballfg.tracks.detections_file import DETECTIONS_FILE, EVENTS_FILE
from ballfg.tracks.info import INFO_FILE
from ballfg.vision.camera_file import CAMERAS_FILE

STATES, MOTION, EVENTS, STROKES = "states.csv", "camera_motion.csv", EVENTS_FILE, "strokes.csv"
COURT: Final = "court.yaml"  # the court, as a user gave it; without this file it is that of table tennis
FILES: Final = (INFO_FILE, STATES, DETECTIONS_FILE, CAMERAS_FILE, MOTION, EVENTS, STROKES, COURT)  # all written files
VIDEOS: Final = (".mp4", ".m4v", ".mov", ".webm", ".mkv", ".avi")
TRACKED: Final = "ballfg track "  # before the name of the video in the source of a rally's dataset


def is_rally(folder: Path) -> bool:
    """True for a folder that `ballfg track` wrote of one moving camera."""
    return all((folder / name).is_file() for name in (INFO_FILE, MOTION, EVENTS, CAMERAS_FILE))
