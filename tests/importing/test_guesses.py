"""The guesses one by one: the fall, the bounces, names, stamps, and measured tracks turned and scaled."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from _pytest.mark.structures import ParameterSet

import ballfg as bf
from ballfg.importing.bounces import Turn, evidence, reverses, surface, turns_of
from ballfg.importing.choices import UndecidedError
from ballfg.importing.fall import AXES, scales
from ballfg.importing.frame import TURNS
from ballfg.importing.names import meanings
from ballfg.importing.stamps import as_stamps, in_seconds, origin_of
from ballfg.tracks import read_dataset
from tests.importing.throws import thrown
from tests.places import DATA


@pytest.mark.parametrize("up", AXES)
def test_turns_are_rotations_that_bring_up_to_z(up: str) -> None:
    turn = np.array(TURNS[up], dtype=float)
    axis = np.zeros(3)
    axis["xyz".index(up[-1])] = -1.0 if up[0] == "-" else 1.0
    np.testing.assert_array_equal(turn @ axis, [0.0, 0.0, 1.0])
    assert np.linalg.det(turn) == pytest.approx(1.0)


@pytest.mark.parametrize(("length", "size"), [("m", 1.0), ("cm", 0.01), ("mm", 0.001), ("in", 0.0254), ("ft", 0.3048)])
@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_units_from_the_fall(length: str, size: float, noise: float) -> None:
    t, p = thrown(noise)
    best = scales([(1e3 * t, p[:, [1, 2, 0]] / size)])[0]
    assert (best.length, best.time, best.up) == (length, "ms", "y")
    assert best.score > 0.5


def test_a_bounce_between_samples() -> None:
    t, p = thrown()
    keep = np.abs(t - 0.35) > 0.003  # no sample at the contact itself
    assert [turn.height for turn in turns_of(t[keep], p[keep])] == [pytest.approx(0.8, abs=0.002)]
    found = surface([thrown(0.003, seed) for seed in range(20)])
    assert found is not None
    assert found.bounces == 20
    assert found.centre == pytest.approx(0.8, abs=0.003)


def test_a_surface_has_one_restitution_and_hits_keep_the_ball_in_the_air() -> None:
    rng = np.random.default_rng(4)
    bounces = [Turn(0.8 + h, 0.75 + e, 0.2) for h, e in zip(*rng.normal(0.0, [[0.003], [0.03]], (2, 8)), strict=True)]
    speeds = rng.uniform(2.0, 4.5, 9)
    hits = [Turn(0.8, up / down, 0.2) for down, up in pairwise(speeds)]
    kept_up = [Turn(turn.height, turn.restitution + 0.25, 0.2) for turn in bounces]
    assert evidence(bounces) > 5.0
    assert max(evidence(hits), evidence(kept_up)) < -5.0
    assert evidence(bounces[:1]) < 3.0  # one turn shows neither one height nor one restitution


def test_walls_and_rackets_reverse_a_motion() -> None:
    t, p = thrown(0.003)
    back = p.copy()
    back[t > 0.5, 0] = 2.0 * p[np.searchsorted(t, 0.5), 0] - p[t > 0.5, 0]
    assert not reverses(t, p)
    assert reverses(t, back)
    astray = p.copy()
    astray[30, 0] += 0.8  # a wrong sample is no wall
    assert not reverses(t, astray)


def _sliding_tennis(friction: float, seed: int) -> np.ndarray:
    """(n, 4) t, x, y, z of a ball, s and m, that slides over a hard court as it bounces at a height of 33.5 mm."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 0.8, 0.01) + rng.uniform(0.0, 0.01)
    down, speed = rng.uniform(5.0, 7.0), rng.uniform(18.0, 25.0)
    e = 0.75 + rng.normal(0.0, 0.03)
    after = np.maximum(t - 0.4, 0.0)
    x = speed * t - friction * (1.0 + e) * down * after
    z = np.where(t < 0.4, (down - 9.81 * 0.4) * (0.4 - t) + 4.905 * (0.16 - t**2), e * down * after - 4.905 * after**2)
    return np.column_stack((t, np.stack((x, 0.1 * t, z + 0.0335), axis=1) + rng.normal(0.0, 0.003, (len(t), 3))))


def test_a_court_as_rough_as_its_ball_is_known_for_is_a_surface() -> None:
    """The ITF rates hard courts up to 0.73; a table is never so rough, and what takes so much is a racket."""
    shots = [_sliding_tennis(friction, seed) for seed, friction in enumerate(np.linspace(0.57, 0.73, 12))]
    assert bf.import_tracks(shots, ball="tennis").info.table_height == pytest.approx(0.0, abs=0.003)
    assert bf.import_tracks(shots).info.table_height is None


def _dragged(drag: float, speed: float, seed: int) -> np.ndarray:
    """(n, 4) t, x, y, z, s and m, of a flight with a drag (1/m), in small steps of Euler's method."""
    state, step, rows = np.array([0.0, 0.0, 1.0, 0.98 * speed, 0.0, 0.2 * speed]), 1e-4, []
    for i in range(6000):
        if i % 100 == 0:
            rows.append([i * step, *state[:3]])
        velocity = state[3:]
        pull = np.array([0.0, 0.0, -9.81]) - drag * float(np.linalg.norm(velocity)) * velocity
        state = state + step * np.concatenate((velocity, pull))
    return np.array(rows) + np.random.default_rng(seed).normal(0.0, [0.0, 0.003, 0.003, 0.003], (60, 4))


@pytest.mark.parametrize(
    ("drag", "speed", "ball", "told"),
    [(0.02, 25.0, None, True), (0.02, 25.0, "tennis", False), (0.12, 10.0, None, False), (0.0, 2.0, None, False)],
    ids=["tennis", "named", "table tennis", "too slow to show a drag"],
)
def test_a_drag_of_another_ball_is_a_doubt(drag: float, speed: float, ball: str | None, *, told: bool) -> None:
    doubts = bf.import_tracks([_dragged(drag, speed, seed) for seed in range(8)], ball=ball).info.doubts
    assert any("the ball flies with a drag of 0.02 1/m, a table-tennis ball with 0.13" in one for one in doubts) == told


@pytest.mark.parametrize(
    ("name", "role", "unit"),
    [
        ("t", "t", None), ("Time [ms]", "t", "ms"), ("timestamp_ns", "t", "ns"), ("Zeit", "t", None),
        ("t(us)", "t", "us"),
        ("X [mm]", "x", "mm"), ("ballZ", "z", None), ("position.y", "y", None), ("pos_x_cm", "x", "cm"),
        ("header.stamp.sec", "seconds", None), ("header.stamp.nanosec", "nanoseconds", None), ("Frame", "frame", None),
        ("sigma_x", "sigma_x", None), ("std_y [mm]", "sigma_y", "mm"), ("shot_id", "trajectory", None),
        ("trackID", "trajectory", None), ("u_px", "", None), ("vx", "", None), ("velocity_x", "", None),
        ("racket_x", "", None), ("spin_z", "", None),
    ],
)  # fmt: skip
def test_names(name: str, role: str, unit: str | None) -> None:
    found = {one.role: one.unit for one in meanings(name)}
    assert found == ({role: unit} if role else {})


def test_nanoseconds_since_1970_keep_their_digits() -> None:
    stamps = as_stamps(np.array([1_763_800_000_000_000_001, 1_763_800_000_000_000_003]))
    assert stamps is not None
    np.testing.assert_array_equal(in_seconds(stamps, "ns", origin_of(stamps, "ns")), [0.0, 2e-9])
    dates = as_stamps(np.array(["2026-03-01T12:00:00.000000001Z", "2026-03-01 13:00:01.5+01:00"], dtype=object))
    assert dates is not None
    assert (dates[1] - dates[0]).item() == 1_499_999_999


def test_a_mirror_is_only_stated() -> None:
    t, p = thrown()
    table = np.column_stack([t, p[:, [0, 2, 1]]])  # x, up, y: left-handed, as Unity has it
    plain, flipped = (bf.import_tracks(table, flip=flip)["000"].positions for flip in (None, "z"))
    np.testing.assert_allclose(plain, p * [1.0, -1.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(flipped, p, atol=1e-12)


def test_positions_alone_need_a_rate() -> None:
    t, p = thrown()
    with pytest.raises(UndecidedError, match=r"fits about 100 Hz\. Decide it with --rate 100"):
        bf.import_tracks(p)
    np.testing.assert_allclose(bf.import_tracks(p, rate=100.0)["000"].times, t, atol=1e-12)


def test_files_with_positions_in_different_columns_are_named(tmp_path: Path) -> None:
    t, p = thrown()
    for name, header in (("ours.csv", "t,x,y,z"), ("theirs.csv", "time,ball_x,ball_y,ball_z")):
        lines = [",".join(map(repr, row)) for row in np.column_stack((t, p)).tolist()]
        (tmp_path / name).write_text("\n".join([header, *lines]), encoding="utf-8")
    with pytest.raises(UndecidedError, match="hold positions in different columns") as refused:
        bf.import_tracks(tmp_path)
    assert refused.value.option == "key"
    assert all(name in str(refused.value) for name in ("ours", "theirs"))


def test_nothing_falls() -> None:
    t = np.arange(0.0, 1.0, 0.01)
    rolling = np.column_stack([t, t, 0.1 * t, 0.0 * t])
    with pytest.raises(UndecidedError, match="--length") as refused:
        bf.import_tracks(rolling)
    assert refused.value.option == "length"
    data = bf.import_tracks(rolling, length="m", time="s", up="z", table_height=-0.02)
    np.testing.assert_array_equal(data["000"].positions, rolling[:, 1:])


def test_a_terminal_is_asked(tmp_path: Path) -> None:
    t, p = thrown()
    lines = [",".join(map(str, (i, *row))) for i, row in enumerate(p.tolist())]
    (tmp_path / "a.csv").write_text("\n".join(["frame,x,y,z", *lines]), encoding="utf-8")
    main, side = pty.openpty()
    words = [
        sys.executable,
        "-c",
        "from ballfg.cli.main import run; run()",
        "import",
        str(tmp_path / "a.csv"),
        "--out",
        str(tmp_path / "out"),
    ]
    with subprocess.Popen(words, stdin=side, stdout=subprocess.DEVNULL, stderr=side) as command:
        os.write(main, b"100\n")
        assert command.wait(60) == 0
    os.close(side)
    assert b"--rate" in os.read(main, 10000)
    os.close(main)
    np.testing.assert_allclose(read_dataset(tmp_path / "out")["000"].times, t, atol=1e-12)


def measured() -> Iterator[ParameterSet]:
    """Every dataset and every way to write it; the quick suite has each once."""
    ways = [("y", 1e3, 1e3), ("-z", 100.0, 1.0), ("x", 1 / 0.3048, 1e6)]
    for i, name in enumerate(("aimy", "ballgun", "robot_rallies", "spindoe")):
        for k, way in enumerate(ways):
            yield pytest.param(name, *way, marks=[pytest.mark.thorough] * (k != i % len(ways)))


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no measured tracks at {DATA}; set BALLFG_DATA")
@pytest.mark.parametrize(("name", "up", "size", "rate"), [*measured()])
def test_measured_tracks(name: str, up: str, size: float, rate: float) -> None:
    data = read_dataset(DATA / name)
    turn = np.array(TURNS[up], dtype=float)
    found = bf.import_tracks([np.column_stack([rate * one.times, size * one.positions @ turn]) for one in data])
    assert len(found) == len(data)
    for one, track in zip(found, data, strict=True):
        np.testing.assert_allclose(one.times, track.times, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(one.positions, track.positions, rtol=0.0, atol=1e-9)
    assert found.table == pytest.approx(data.table, abs=0.01)


def test_names_of_shots_stay_text() -> None:
    t, p = thrown()
    names = ["007", "8", "warm up", "1e3"]
    rows = [{"shot": name, "t": float(a), "pos": b} for name in names for a, b in zip(t, p.tolist(), strict=True)]
    assert bf.import_tracks(rows).names == names
    mostly_numbers = [row | {"shot": {"007": "7", "1e3": "9"}.get(row["shot"], row["shot"])} for row in rows]
    assert bf.import_tracks(mostly_numbers).names == ["7", "8", "warm up", "9"]


def test_a_dataset_is_imported_with_its_labels(tmp_path: Path) -> None:
    t, p = thrown()
    rows = [{"shot": name, "t": float(a), "pos": b} for name in "abc" for a, b in zip(t, p.tolist(), strict=True)]
    bf.import_tracks(rows, out=tmp_path / "one")
    labels = "trajectory,spin_x,spin_y,spin_z,group\na,1,2,3,slow\nb,4,5,6,fast\nc,7,8,9,fast\n"
    (tmp_path / "one" / "labels.csv").write_text(labels, encoding="utf-8")
    data = bf.import_tracks(tmp_path / "one", out=tmp_path / "two")
    assert data["b"].labels == {"spin_x": 4.0, "spin_y": 5.0, "spin_z": 6.0, "group": "fast"}
    np.testing.assert_allclose(data["a"].positions, p, atol=1e-12)


def test_files_under_other_names(tmp_path: Path) -> None:
    t, p = thrown()
    table = np.column_stack([t, p])
    np.save(tmp_path / "a.npy", table)
    np.savez(tmp_path / "b.npz", shot=table)
    (tmp_path / "b.npz").rename(tmp_path / "b.data")
    for name in ("a.npy", "b.data"):
        np.testing.assert_allclose(bf.import_tracks(tmp_path / name)["000"].positions, p, atol=1e-12)


def test_places_that_stick_to_a_limit_and_stated_units_that_do_not_fall_are_doubts() -> None:
    shots = [thrown(0.003, seed) for seed in range(6)]
    rows = [np.column_stack((t, np.minimum(p, [0.9, 9.0, 9.0]))) for t, p in shots]
    clipped = bf.import_tracks(rows, length="m", time="s", up="z").info.doubts
    assert any(one.startswith("x is clipped: 6 times it stays at 0.9 m") for one in clipped)
    plain = [np.column_stack(shot) for shot in shots]
    assert bf.import_tracks(plain, length="m", time="s", up="z", ball="tennis").info.doubts == ()  # with little drag
    wrong = bf.import_tracks(plain, length="ft", time="s", up="z", table_height=0.0).info.doubts
    assert any("in m and s with z up, not in ft" in one for one in wrong)
