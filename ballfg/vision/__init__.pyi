from .association.agreement import check_agreement as check_agreement
from .association.associate import AssociationSettings as AssociationSettings, associate as associate
from .association.triangulate import triangulate as triangulate
from .camera import Camera as Camera
from .camera_file import read_cameras as read_cameras
from .detection.detect import detect as detect, detect_all as detect_all, learn_detector as learn_detector
from .detection.detections import Candidates as Candidates, Detections as Detections
from .detection.detector import DetectorSettings as DetectorSettings
from .detection.video import open_video as open_video
from .tracking.dataset import write_tracking as write_tracking
from .tracking.pipeline import track_detections as track_detections, track_videos as track_videos
