"""Bags without ROS: states of a session are read back as positions, with their stamps and covariances."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ballfg.live import BallUpdate, Tracker
from ballfg.live.bag_writer import PATHS, STATES, bag_writer
from ballfg.live.outlook import Outlook
from ballfg.live.sources.bag import bag_samples
from tests.live.shots import SURFACES, ball_model, ball_settings, rows, shots

pytest.importorskip("rosbags", reason="the extra 'ros' is not installed")


@pytest.fixture(scope="module")
def updates() -> list[BallUpdate]:
    live = Tracker(ball_model(), SURFACES, ball_settings())
    return [update for t, *position in rows(shots(1)[0], later=1.7e9)[:16] for update in live.push(t, position)]


@pytest.fixture(scope="module")
def bag(updates: list[BallUpdate], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("bags") / "states.mcap"
    with bag_writer(out, horizon=0.1) as writer:
        for update in updates:
            writer.see(update, Outlook() if update is updates[-1] else Outlook(note="not wanted"))
    assert [path.name for path in out.parent.iterdir()] == ["states.mcap"]
    return out


def test_states_come_back(bag: Path, updates: list[BallUpdate]) -> None:
    states = [update.state for update in updates if update.state is not None]
    samples = list(bag_samples(bag, STATES))
    assert samples == list(bag_samples(bag, None))
    assert len(samples) == len(states) == 14
    for sample, state in zip(samples, states, strict=True):
        assert sample.time == pytest.approx(state.time, abs=1e-6)
        np.testing.assert_array_equal(sample.positions, [state.position])
        np.testing.assert_allclose(sample.sigmas, [state.sigmas[:3]], rtol=1e-12)


def test_velocity_spin_and_the_path_are_in_the_messages(bag: Path, updates: list[BallUpdate]) -> None:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    found: dict[str, list] = {}
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, _, data in reader.messages():
            found.setdefault(connection.topic, []).append(reader.deserialize(data, connection.msgtype))
    state, last = updates[-1].state, found[STATES][-1]
    assert state is not None
    assert (last.header.frame_id, last.child_frame_id) == ("world", "ball_1")
    assert [last.twist.twist.linear.x, last.twist.twist.angular.z] == [state.velocity[0], state.spin[2]]
    np.testing.assert_array_equal(last.twist.covariance.reshape(6, 6), state.covariance[3:, 3:])
    (path,) = found[PATHS]
    ahead = state.predict(0.1)
    assert len(path.poses) == len(ahead.times) + 1
    assert path.poses[-1].pose.position.x == pytest.approx(ahead.positions[-1, 0], abs=1e-9)


def test_bags_and_topics_that_are_not_there_are_named(bag: Path, tmp_path: Path) -> None:
    with pytest.raises(
        ValueError, match=r"topic must be one of PointStamped, .*; got '/ball'. .*states.mcap has: .*/ball/path"
    ):
        bag_samples(bag, "/ball")
    with pytest.raises(FileNotFoundError, match="bag must exist"):
        bag_samples(tmp_path / "none.mcap", None)
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"no bag at all")
    with pytest.raises(ValueError, match=r"broken\.mcap must be a whole bag file"):
        bag_samples(broken, None)
