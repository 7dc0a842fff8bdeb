"""Reads positions from rosbag2 folders and MCAP files, without ROS; it needs the extra `ros`."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ballfg.checks import listed
from ballfg.files.damaged import library_reads
from ballfg.live.mcap import readable
from ballfg.live.sources.bag_limits import check_bag
from ballfg.live.sources.lines import Sample

Point = Any
Reading = tuple[Sequence[Point], Any]  # The points of a message, and the covariance (36,) of a single one or None

READERS: dict[str, Callable[[Any], Reading]] = {
    "geometry_msgs/msg/PointStamped": lambda m: ([m.point], None),
    "geometry_msgs/msg/PoseStamped": lambda m: ([m.pose.position], None),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: ([m.pose.pose.position], m.pose.covariance),
    "geometry_msgs/msg/PoseArray": lambda m: ([pose.position for pose in m.poses], None),
    "geometry_msgs/msg/TransformStamped": lambda m: ([m.transform.translation], None),
    "nav_msgs/msg/Odometry": lambda m: ([m.pose.pose.position], m.pose.covariance),
}
"""Reader of positions for each type of message."""


def need_rosbags() -> None:
    """Raises ValueError without the extra."""
    try:
        import rosbags  # noqa: F401
    except ImportError as error:
        raise ValueError(
            f"bags must be read and written by the package rosbags; got {error}. Install it: pip install 'ballfg[ros]'."
        ) from None


def bag_samples(bag: Path, topic: str | None) -> Iterator[Sample]:
    """The positions of a topic, with the stamps of their headers.

    Args: bag: a folder of rosbag2, or a file .mcap or .db3.  topic: None takes the only one with positions.
    Raises: ValueError: no such topic, or the package `rosbags` is missing. FileNotFoundError: no such bag.
    """
    need_rosbags()
    if not bag.exists():
        raise FileNotFoundError(f"bag must exist; {bag} does not. Give a folder of rosbag2 or a file .mcap.")
    check_bag(bag)
    chosen = _topic(bag, topic)
    return _samples(bag, chosen)


def _opened(bag: Path) -> Any:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    path = readable(bag) if bag.suffix == ".mcap" else bag
    return AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))


def _topic(bag: Path, topic: str | None) -> str:
    """The topic to read. Raises: ValueError: no such topic."""
    with library_reads(bag, "bag"), _opened(bag) as reader:
        kinds = {connection.topic: str(connection.msgtype) for connection in reader.connections}
    good = [name for name, kind in kinds.items() if kind in READERS]
    held = listed([f"{name} ({kind})" for name, kind in kinds.items()])
    if topic is None and len(good) == 1:
        return good[0]
    if topic is None or topic not in good:
        known = ", ".join(kind.rpartition("/")[2] for kind in READERS)
        got = f"{topic!r}" if topic is not None else "none"
        raise ValueError(f"topic must be one of {known}; got {got}. {bag} has: {held}. Choose with --topic.")
    return topic


def _samples(bag: Path, topic: str) -> Iterator[Sample]:
    with library_reads(bag, "bag"), _opened(bag) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        for connection, _, data in reader.messages(connections=connections):
            message = reader.deserialize(data, connection.msgtype)
            stamp = message.header.stamp
            points, covariance = READERS[connection.msgtype](message)
            if len(points):
                positions = [[float(p.x), float(p.y), float(p.z)] for p in points]
                yield Sample(stamp.sec + 1e-9 * stamp.nanosec, positions, _sigmas(covariance))


def _sigmas(covariance: Any) -> list[list[float]] | None:
    """m, from the covariance (36,) of a pose; None without one."""
    if covariance is None:
        return None
    variances = np.asarray(covariance, dtype=np.float64).reshape(6, 6).diagonal()[:3]
    return [np.sqrt(variances).tolist()] if (np.isfinite(variances) & (variances > 0.0)).all() else None
