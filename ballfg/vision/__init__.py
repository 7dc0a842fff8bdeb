"""From cameras to tracks: camera models, calibration, detection, association, triangulation."""

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
from ballfg.vision.tracking.pipeline import Tracking, track_detections, track_videos

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
]
