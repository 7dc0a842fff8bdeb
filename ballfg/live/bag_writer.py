"""States and predictions as ROS 2 messages in an MCAP file, without ROS: the extra `ros`."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.online.state import OnlineState
from ballfg.files.whole_file import whole_file
from ballfg.live.outlook import Outlook, unusable
from ballfg.live.sources.bag import need_rosbags
from ballfg.live.tracker import BallUpdate
from ballfg.state import POSITION, SPIN, VELOCITY

FRAME = "world"
STATES = "/ball/odometry"
PATHS = "/ball/path"
UNKNOWN = 1e6
"""rad^2, variance of an orientation: a ball's is not estimated."""


@contextmanager
def bag_writer(out: Path, horizon: float) -> Iterator[BagWriter]:
    """A writer to an MCAP file, which gets its name when the block ends well.

    Args: out: the file.  horizon: s, of the paths.
    Raises: ValueError: the package `rosbags` is missing, or `out` is a folder. FileNotFoundError: no such folder.
    """
    need_rosbags()
    from rosbags.rosbag2 import StoragePlugin, Writer

    with whole_file(out) as temporary:
        bag = temporary.with_name("bag")
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            yield BagWriter(writer, horizon)
        (written,) = bag.glob("*.mcap")
        os.replace(written, temporary)


class BagWriter:
    """Writes `nav_msgs/Odometry` for each state and `nav_msgs/Path` for its prediction.

    Args: writer: of rosbags, open.  horizon: s, of the paths.
    """

    def __init__(self, writer: Any, horizon: float) -> None:
        from rosbags.typesys import Stores, get_typestore

        self.store = get_typestore(Stores.ROS2_HUMBLE)
        self.writer = writer
        self.horizon = horizon
        self._states = writer.add_connection(STATES, "nav_msgs/msg/Odometry", typestore=self.store)
        self._paths = writer.add_connection(PATHS, "nav_msgs/msg/Path", typestore=self.store)

    def see(self, update: BallUpdate, outlook: Outlook | None) -> None:
        """Write a state and its prediction."""
        state = update.state
        if update.kind != "state" or state is None:
            return
        self._write(self._states, self._odometry(state, f"ball_{update.ball}"), state.time)
        if outlook is not None and not outlook.note and not unusable(state):
            ahead = state.predict(self.horizon)
            times = np.concatenate(([state.time], ahead.times))
            self._write(self._paths, self._path(times, np.vstack((state.position, ahead.positions))), state.time)

    def _write(self, connection: Any, message: Any, time: float) -> None:
        data = self.store.serialize_cdr(message, message.__msgtype__)
        self.writer.write(connection, max(round(1e9 * time), 0), data)

    def _odometry(self, state: OnlineState, name: str) -> Any:
        types = self.store.types
        pose, twist = np.diag([0.0] * 3 + [UNKNOWN] * 3), np.asarray(state.covariance[3:, 3:])
        pose[:3, :3] = state.covariance[POSITION, POSITION]
        moving = types["geometry_msgs/msg/Twist"](self._vector(state.mean[VELOCITY]), self._vector(state.mean[SPIN]))
        return types["nav_msgs/msg/Odometry"](
            self._header(state.time),
            name,
            types["geometry_msgs/msg/PoseWithCovariance"](self._pose(state.position), pose.ravel()),
            types["geometry_msgs/msg/TwistWithCovariance"](moving, twist.ravel()),
        )

    def _path(self, times: Array, positions: Array) -> Any:
        stamped = self.store.types["geometry_msgs/msg/PoseStamped"]
        poses = [stamped(self._header(float(t)), self._pose(p)) for t, p in zip(times, positions, strict=True)]
        return self.store.types["nav_msgs/msg/Path"](self._header(float(times[0])), poses)

    def _header(self, time: float) -> Any:
        seconds, rest = divmod(round(1e9 * time), 10**9)
        stamp = self.store.types["builtin_interfaces/msg/Time"](seconds, rest)
        return self.store.types["std_msgs/msg/Header"](stamp, FRAME)

    def _pose(self, position: Array) -> Any:
        types = self.store.types
        upright = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        return types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](*map(float, position)), upright)

    def _vector(self, values: Array) -> Any:
        return self.store.types["geometry_msgs/msg/Vector3"](*map(float, values))
