"""Bags without ROS: states of a session are read back as positions, with their stamps and covariances."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ballfg.live import BallUpdate, Tracker, recording
from ballfg.live.bag_writer import PATHS, STATES, BagWriter
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
    with BagWriter(out, horizon=0.1) as writer:
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


def positions_of(bag: Path) -> list[list[list[float]]]:
    return [sample.positions for sample in bag_samples(bag, STATES)]


def test_a_bag_cut_anywhere_is_read(updates: list[BallUpdate], tmp_path: Path) -> None:
    """Chunks of one, two, ... states, cut at each of many places: what was whole is read."""
    states = [update for update in updates if update.state is not None]
    whole, ends = tmp_path / "whole.mcap", []
    with BagWriter(whole, horizon=0.1) as writer:
        begin = whole.stat().st_size
        for k in range(1, 5):
            for update in states[k * (k - 1) // 2 : k * (k + 1) // 2]:
                writer.see(update, Outlook())
            writer._flush()
            ends.append(whole.stat().st_size)
    content, expected = whole.read_bytes(), positions_of(whole)
    assert len(expected) == 10
    places = [*range(0, begin, 2003), *range(begin, len(content), 3001), *ends, ends[-1] - 1, len(content) - 1]
    for place in places:
        cut = tmp_path / "cut.mcap"
        cut.write_bytes(content[:place])
        chunks = sum(place >= end for end in ends)
        kept = expected[: chunks * (chunks + 1) // 2]
        if place >= begin:
            assert positions_of(cut) == kept
            assert cut.stat().st_size == place, "a reader must not write"
    for place, damage in ((ends[0], b"\0"), (ends[-1], b"\0" * 9), (ends[-1], b"\x06" + b"\0" * 100)):
        damaged = content[:place] + damage + content[place + len(damage) : ends[-1] + len(damage)]
        cut.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"cut\.mcap must be a whole bag file"):
            positions_of(cut)


def test_a_bag_is_a_new_file(bag: Path) -> None:
    before = bag.read_bytes()
    with pytest.raises(ValueError, match="out must be a new file for a bag"):
        BagWriter(bag, 0.1)
    assert bag.read_bytes() == before


def test_states_reach_a_bag_while_nothing_more_comes(
    updates: list[BallUpdate], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "states.mcap"
    monkeypatch.setattr(recording, "EVERY", 0.05)
    with BagWriter(out, horizon=0.1) as writer:
        writer.see(updates[-1], None)
        deadline = time.monotonic() + 20.0
        while not positions_of(out):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert len(positions_of(out)) == 1
    assert len(positions_of(out)) == 1


def test_a_stamp_that_no_message_holds_is_left_out(updates: list[BallUpdate], tmp_path: Path) -> None:
    state = updates[-1].state
    assert state is not None
    with BagWriter(tmp_path / "states.mcap", horizon=0.1) as writer:
        for time_ in (1e18, 2.0**31, -1e300):
            writer.see(replace(updates[-1], state=replace(state, time=time_)), None)
    assert positions_of(tmp_path / "states.mcap") == []


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
