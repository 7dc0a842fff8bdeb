"""From cameras to tracks: camera models, calibration, detection, association, triangulation.

Names are imported when they are asked for: a process that looks for balls in a video must not wait for torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ballfg.vision.association.agreement import Agreement, check_agreement
    from ballfg.vision.association.associate import AssociationSettings, associate
    from ballfg.vision.association.seen_ball import SeenBall
    from ballfg.vision.association.triangulate import Triangulated, triangulate
    from ballfg.vision.calibration.extrinsics import calibrate_extrinsics
    from ballfg.vision.calibration.intrinsics import calibrate_intrinsics
    from ballfg.vision.camera import Camera
    from ballfg.vision.camera_file import read_cameras, write_cameras
    from ballfg.vision.camera_storage import write_opencv
    from ballfg.vision.detection.detect import detect, detect_all, learn_detector
    from ballfg.vision.detection.detections import Candidates, Detections, Detector
    from ballfg.vision.detection.detector import BallDetector, DetectorSettings
    from ballfg.vision.detection.video import Video, open_video
    from ballfg.vision.projection import CameraBank
    from ballfg.vision.tracking.dataset import write_tracking
    from ballfg.vision.tracking.pipeline import Tracking, track_detections, track_videos

_PLACES = {
    "association.agreement": ("Agreement", "check_agreement"),
    "association.associate": ("AssociationSettings", "associate"),
    "association.seen_ball": ("SeenBall",),
    "association.triangulate": ("Triangulated", "triangulate"),
    "calibration.extrinsics": ("calibrate_extrinsics",),
    "calibration.intrinsics": ("calibrate_intrinsics",),
    "camera": ("Camera",),
    "camera_file": ("read_cameras", "write_cameras"),
    "camera_storage": ("write_opencv",),
    "detection.detect": ("detect", "detect_all", "learn_detector"),
    "detection.detections": ("Candidates", "Detections", "Detector"),
    "detection.detector": ("BallDetector", "DetectorSettings"),
    "detection.video": ("Video", "open_video"),
    "projection": ("CameraBank",),
    "tracking.dataset": ("write_tracking",),
    "tracking.pipeline": ("Tracking", "track_detections", "track_videos"),
}
_MODULE_OF = {name: place for place, names in _PLACES.items() for name in names}

__all__ = [
    "Agreement",
    "AssociationSettings",
    "BallDetector",
    "Camera",
    "CameraBank",
    "Candidates",
    "Detections",
    "Detector",
    "DetectorSettings",
    "SeenBall",
    "Tracking",
    "Triangulated",
    "Video",
    "associate",
    "calibrate_extrinsics",
    "calibrate_intrinsics",
    "check_agreement",
    "detect",
    "detect_all",
    "learn_detector",
    "open_video",
    "read_cameras",
    "track_detections",
    "track_videos",
    "triangulate",
    "write_cameras",
    "write_opencv",
    "write_tracking",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
