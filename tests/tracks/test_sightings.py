"""Sightings and their file: what is kept bit for bit, what is put in order, what is refused and where it stands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ballfg.tracks.detections_file import read_sightings
from ballfg.tracks.sightings import Sightings
from tests.written_tables import write_sightings

OFFSETS = {"left": 0.0, "right": 0.004}


def sightings(m: int = 6, **changes: object) -> Sightings:
    rng = np.random.default_rng(0)
    root = rng.uniform(0.2, 0.5, (m, 2, 2)) * [[1, 0], [1, 1]]
    fields = {
        "cameras": ("left", "right"),
        "camera": np.arange(m) % 2,
        "times": 0.1 + 0.01 * np.arange(m) + 0.004 * (np.arange(m) % 2),
        "pixels": rng.uniform(0, 700, (m, 2)),
        "covariances": root @ root.swapaxes(-1, -2),
    }
    return Sightings(**(fields | changes))


def test_rows_can_be_taken() -> None:
    whole = sightings()
    for part in (whole.select(np.array([1, 4])), whole.select(np.arange(6) % 3 == 1)):
        assert len(part) == 2
        np.testing.assert_array_equal(part.times, whole.times[[1, 4]])
        np.testing.assert_array_equal(part.camera, [1, 0])
    with pytest.raises(ValueError, match="m >= 1"):
        whole.select(np.zeros(6, dtype=bool))


def test_arrays_are_copies() -> None:
    pixels = np.ones((6, 2))
    kept = sightings(pixels=pixels)
    pixels[0] = 5.0
    assert kept.pixels[0, 0] == 1.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cameras": ("left", "left")}, "cameras must be different names"),
        ({"cameras": ()}, "cameras must be different names"),
        ({"camera": np.array([0, 1, 2, 0, 1, 0])}, "whole numbers from 0 to 1"),
        ({"camera": np.zeros(6)}, "whole numbers from 0 to 1"),
        ({"times": np.zeros((6, 1))}, r"times must have shape \(m,\)"),
        (
            {"times": np.array([0.0, 0, 1, 1, 1, 2])},
            r"times of camera 'left' must increase; times\[4\]=1.0 <= times\[2\]=1.0",
        ),
        ({"pixels": np.zeros((5, 2))}, r"pixels must have shape \(6, 2\); got \(5, 2\)"),
        ({"pixels": np.full((6, 2), np.inf)}, r"pixels must be finite; pixels\[0\]"),
        ({"pixels": "here"}, "pixels must be an array of numbers"),
        ({"covariances": np.tile([[1.0, 2.0], [2.0, 1.0]], (6, 1, 1))}, r"positive definite; covariances\[0\]"),
        ({"covariances": np.tile([[1.0, 0.1], [0.2, 1.0]], (6, 1, 1))}, "must be symmetric"),
        ({"radii": np.ones((6, 1))}, r"radii must have shape \(6, 2\)"),
        ({"radii": np.tile([5.0, 0.0], (6, 1))}, r"a sigma above zero, in px; radii\[0\]=\[5.0, 0.0\]"),
    ],
)
def test_refuses(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        sightings(**changes)


def test_file_gives_back_what_was_written(tmp_path: Path) -> None:
    balls = {"b": sightings(), "a": sightings(4)}
    write_sightings(tmp_path / "detections.csv", balls.items())
    read, notes = read_sightings(tmp_path / "detections.csv", OFFSETS)
    assert notes == []
    assert list(read) == ["b", "a"]
    for name, ball in balls.items():
        order = np.argsort(ball.times - np.array([0.0, 0.004])[ball.camera], kind="stable")
        np.testing.assert_array_equal(read[name].camera, ball.camera[order])
        np.testing.assert_array_equal(read[name].times, ball.times[order])
        np.testing.assert_array_equal(read[name].pixels, ball.pixels[order])
        np.testing.assert_allclose(read[name].covariances, ball.covariances[order], rtol=1e-14)


def test_radii_are_kept_and_unknown_ones_may_be_zero(tmp_path: Path) -> None:
    radii = np.column_stack((np.array([5.0, 6.0, 0.0, 7.5, 8.0, 9.0]), np.full(6, 0.3)))
    ball = sightings(radii=radii)
    np.testing.assert_array_equal(ball.select(np.array([1, 2])).radii, radii[1:3])
    write_sightings(tmp_path / "detections.csv", [("a", ball)])
    read, notes = read_sightings(tmp_path / "detections.csv", OFFSETS)
    assert notes == []
    assert read["a"].radii is not None
    np.testing.assert_array_equal(np.sort(read["a"].radii, axis=0), np.sort(radii, axis=0))
    text = (tmp_path / "detections.csv").read_text().replace(",9.0,", ",-9.0,").replace(",9,", ",-9,")
    (tmp_path / "detections.csv").write_text(text)
    with pytest.raises(ValueError, match=r"column 'radius': must be 0 \(unknown\) to 1000000 px; got -9"):
        read_sightings(tmp_path / "detections.csv", OFFSETS)


def test_an_unknown_radius_has_any_sigma(tmp_path: Path) -> None:
    path = tmp_path / "detections.csv"
    head = "trajectory,t,camera,u,v,radius,sigma_radius\na,0.1,left,1,2,5,0.3\n"
    path.write_text(head + "a,0.2,left,1,2,0,0\na,0.3,left,1,2,0,0.7\n")
    radii = read_sightings(path, OFFSETS)[0]["a"].radii
    assert radii is not None
    np.testing.assert_array_equal(radii[:, 0], [5.0, 0.0, 0.0])
    assert radii[0, 1] == 0.3
    path.write_text(head + "a,0.2,left,1,2,6,0\n")
    with pytest.raises(ValueError, match=r"line 3, column 'sigma_radius': must be 0\.0001 to 1000000 px; got 0"):
        read_sightings(path, OFFSETS)


def test_exact_repeats_of_rows_are_dropped(tmp_path: Path) -> None:
    """Another ball, camera, or place in the same frame is none."""
    path, rows = tmp_path / "detections.csv", ["a,0.1,left,1,2", "b,0.1,left,1,2", "a,0.1,right,1,2", "a,0.2,left,1,2"]
    path.write_text("\n".join(["trajectory,t,camera,u,v", *rows, *rows[1:]]) + "\n")
    read, notes = read_sightings(path, OFFSETS)
    assert notes == ["detections.csv: 3 exact repeats of rows dropped"]
    assert [(name, len(ball)) for name, ball in read.items()] == [("a", 3), ("b", 1)]
    path.write_text("\n".join(["trajectory,t,camera,u,v", *rows, rows[0], "a,0.1,left,1,3"]) + "\n")
    with pytest.raises(ValueError, match="lines 2 and 7: one ball must be seen once"):
        read_sightings(path, OFFSETS)


def test_rows_are_put_in_order_of_true_time(tmp_path: Path) -> None:
    path = tmp_path / "detections.csv"
    path.write_text("trajectory,t,camera,u,v\na,0.104,right,1,2\na,0.102,left,3,4\na,0.103,right,5,6\n")
    (ball,) = read_sightings(path, OFFSETS)[0].values()
    np.testing.assert_array_equal(ball.times, [0.103, 0.104, 0.102])
    np.testing.assert_array_equal(ball.covariances, np.tile(0.25 * np.eye(2), (3, 1, 1)))  # half a pixel where unstated


def test_best_candidate_counts_and_the_rest_is_told(tmp_path: Path) -> None:
    path = tmp_path / "detections.csv"
    rows = ["a,0.1,left,1,2,0.3,x", "a,0.1,left,7,8,0.9,x", ",0.1,left,5,6,1.0,x", "a,0.1,right,3,4,0.5,x"]
    path.write_text("\n".join(["trajectory,t,camera,u,v,score,area", *rows]) + "\n")
    read, notes = read_sightings(path, OFFSETS)
    np.testing.assert_array_equal(read["a"].pixels, [[3.0, 4.0], [7.0, 8.0]])
    assert notes == [
        "detections.csv: column 'area' ignored",
        "detections.csv: 1 row without a trajectory left out",
        "detections.csv: 1 candidates with a lower score than another of the same ball left out",
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("trajectory,time,camera,u,v\n", "column 't' is missing; .* Did you mean 'time'"),
        ("trajectory,t,camera,u,v,u\na,0,left,1,2,3\n", "column 'u' must appear once"),
        ("trajectory,t,camera,u,v\na,0,left,1,2\na,1,left,x,2\n", "line 3, column 'u': must be a number"),
        ("trajectory,t,camera,u,v\na,0,left,1,2\na,1,left,1\n", "line 3: must have 5 cells"),
        ("trajectory,t,camera,u,v\na,0,left,nan,2\n", "line 2, column 'u': must be finite, at most 1000000 px; got"),
        (
            "trajectory,t,camera,u,v\na,0,lefd,1,2\n",
            "line 2, column 'camera': must be a camera: left, right; got 'lefd'",
        ),
        (
            "trajectory,t,camera,u,v,sigma_u\na,0,left,1,2,0\n",
            "line 2, column 'sigma_u': must be 0.0001 to 1000000 px; got 0",
        ),
        ("trajectory,t,camera,u,v,rho_uv\na,0,left,1,2,1\n", "column 'rho_uv': must be between -1 and 1"),
        (
            "trajectory,t,camera,u,v\na,0,left,1,2\nb,0,left,1,2\na,0,left,3,4\n",
            "lines 2 and 4: one ball must be seen once",
        ),
    ],
)
def test_bad_file_is_refused_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "detections.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_sightings(path, OFFSETS)


def test_missing_file_and_nameless_rows(tmp_path: Path) -> None:
    path = tmp_path / "detections.csv"
    with pytest.raises(FileNotFoundError, match="must be a table of detections"):
        read_sightings(path, OFFSETS)
    path.write_text("trajectory,t,camera,u,v\n,0,left,1,2\n")
    assert read_sightings(path, OFFSETS) == ({}, ["detections.csv: 1 row without a trajectory left out"])
