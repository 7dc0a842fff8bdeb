"""Writes states and predictions as ROS 2 messages to an MCAP file, without ROS; it needs the extra `ros`."""

import threading
from pathlib import Path
from typing import Any, Self

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.online.state import OnlineState
from ballfg.live.mcap import Chunk, Message, chunk_of, ending, opening
from ballfg.live.outlook import Outlook, unusable
from ballfg.live.recording import Recording
from ballfg.live.sources.bag import need_rosbags
from ballfg.live.tracker import BallUpdate
from ballfg.state import POSITION, SPIN, VELOCITY

FRAME = "world"
STATES = "/ball/odometry"
PATHS = "/ball/path"
TOPICS = ((STATES, "nav_msgs/msg/Odometry"), (PATHS, "nav_msgs/msg/Path"))
LATEST = 2.1e9  # s; later stamps do not fit a ROS message, whose seconds have 32 bits
UNKNOWN = 1e6  # rad^2, variance of the orientation, which is not estimated


class BagWriter:
    """Appends `nav_msgs/Odometry` for each state and `nav_msgs/Path` for its prediction to an MCAP file.

    The messages of half a second form one chunk. The end of the file is written when the context ends; readers of this
    package add it to the file of a killed writer.

    Args: out: the file.  horizon: s, of the paths.
    Raises: ValueError: the package `rosbags` is missing, or the file holds something; and as `Recording`.
    """

    def __init__(self, out: Path, horizon: float) -> None:
        need_rosbags()
        from rosbags.typesys import Stores, get_typestore

        self.store = get_typestore(Stores.ROS2_HUMBLE)
        self.horizon = horizon
        self._opening = opening([(name, kind, self.store.generate_msgdef(kind)[0]) for name, kind in TOPICS])
        self._chunks: list[Chunk] = []
        self._messages: list[Message] = []
        self._turn = threading.Lock()
        self._recording = Recording(out, self._flush)
        if self._recording.size:
            self._recording.__exit__()
            raise ValueError(f"out must be a new file for a bag; {out} holds something. Choose another name.")
        self._recording.append(self._opening)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with self._recording:
            self._flush()
            self._recording.append(ending(self._opening, self._chunks, len(TOPICS)))

    def _flush(self) -> None:
        with self._turn:
            if self._messages:
                content, chunk = chunk_of(self._messages, len(TOPICS), self._recording.size)
                self._messages = []
                self._recording.append(content)
                self._chunks.append(chunk)

    def see(self, update: BallUpdate, outlook: Outlook | None) -> None:
        """Writes a state and its prediction."""
        state = update.state
        if update.kind != "state" or state is None or abs(state.time) > LATEST:
            return
        self._write(1, self._odometry(state, f"ball_{update.ball}"), state.time)
        if outlook is not None and not outlook.note and not unusable(state):
            ahead = state.predict(self.horizon)
            times = np.concatenate(([state.time], ahead.times))
            self._write(2, self._path(times, np.vstack((state.position, ahead.positions))), state.time)
        self._recording.check()

    def _write(self, channel: int, message: Any, time: float) -> None:
        data = bytes(self.store.serialize_cdr(message, message.__msgtype__))
        with self._turn:
            self._messages.append(Message(channel, max(round(1e9 * time), 0), data))

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
