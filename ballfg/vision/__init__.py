"""From cameras to tracks: camera models, calibration, detection, association, triangulation."""

from ballfg.vision.camera import Camera
from ballfg.vision.projection import CameraBank

__all__ = ["Camera", "CameraBank"]
