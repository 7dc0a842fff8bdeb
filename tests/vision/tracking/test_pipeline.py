"""From candidates to a dataset on disk: balls, tables, an empty recording, a detector from a file."""

from __future__ import annotations

import csv
import pickle
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from cloudpickle import dumps

from ballfg.tracks import TABLE_TENNIS, read_dataset
from ballfg.tracks.info import DatasetInfo
from ballfg.vision import Camera
from ballfg.vision.camera_file import read_cameras
from ballfg.vision.detection.detect import load_detector
from ballfg.vision.detection.detections import Candidates, Detections, read_detections
from ballfg.vision.detection.video import Video, open_video
from ballfg.vision.tracking.dataset import FILES, check_result_folder, write_tracking
from ballfg.vision.tracking.overlay import Image
from ballfg.vision.tracking.pipeline import Tracking, no_ball, summary, track_detections
from tests.places import DOCS
from tests.vision.filming import level

RATE = 100.0
FRAMES, START, END = 80, 20, 60
SIGMA = 0.2
INFO = DatasetInfo("made", 0.0, TABLE_TENNIS)
WRITTEN = set(FILES) - {"overlay.mp4", "states.csv", "events.csv"}


RIG = [level("left", -0.7, 2.5), level("middle", 0.1, 2.5), level("right", 0.8, 2.5)]


def centre(times: np.ndarray) -> np.ndarray:
    """(n, 3) m, a throw."""
    s = times - START / RATE
    return np.column_stack((-0.7 + 3.5 * s, 0.1 * s, -0.2 + 2.0 * s - 4.905 * s**2))


def seen(model: Camera, clutter: np.random.Generator, ball: bool = True) -> Detections:
    """The throw among two wrong candidates a frame."""
    frames = []
    for i in range(FRAMES):
        pixels = [*clutter.uniform((0, 0), model.size, (2, 2))]
        scores = [0.35, 0.1]
        if ball and START <= i < END:
            pixels.insert(i % 3, model.project(centre(np.array([i / RATE])))[0] + SIGMA * clutter.normal(size=2))
            scores.insert(i % 3, 0.9)
        frames.append((i / RATE, Candidates.at(np.array(pixels), SIGMA, scores)))
    return Detections.of_frames(model.name, frames)


@pytest.fixture(scope="module")
def tracking() -> Tracking:
    clutter = np.random.default_rng(3)
    return track_detections([seen(model, clutter) for model in reversed(RIG)], RIG)


@pytest.fixture(scope="module")
def empty() -> Tracking:
    clutter = np.random.default_rng(4)
    return track_detections([seen(model, clutter, ball=False) for model in RIG], RIG)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


# --- balls ---------------------------------------------------------------------------------------------------------


def test_the_throw_is_one_ball_where_it_was(tracking: Tracking) -> None:
    (ball,) = tracking.balls
    assert [d.camera for d in tracking.detections] == [c.name for c in tracking.cameras] == ["left", "middle", "right"]
    assert len(ball.times) >= 0.97 * (END - START)
    error = ball.points - centre(ball.times)
    assert np.sqrt((error**2).sum(axis=1).mean()) < 0.004  # 0.2 px at 2.5 m and 500 px are 1 mm
    (track,) = tracking.tracks
    assert track.name == "000"
    assert track.sigmas == pytest.approx(np.sqrt(np.diagonal(ball.covariances, axis1=1, axis2=2)))
    assert tracking.agreement is not None
    assert tracking.agreement.culprit is None


def test_the_candidates_of_a_ball_are_found_again(tracking: Tracking) -> None:
    (ball,) = tracking.balls
    for number, detections in enumerate(tracking.detections):
        picked = tracking.rows(ball, number)
        frames, pixels = tracking.seen(ball, number)
        assert np.array_equal(detections.pixels[picked], pixels)
        assert np.array_equal(detections.frame[picked], frames)
        assert (detections.scores[picked] > 0.8).all()


def test_cameras_and_detections_must_go_together(tracking: Tracking) -> None:
    with pytest.raises(ValueError, match="at least 2; got 1"):
        track_detections(tracking.detections[:1], RIG[:1])
    with pytest.raises(ValueError, match="one for each camera"):
        track_detections(tracking.detections[:2], RIG)
    late = replace(tracking.detections[1], frames=tracking.detections[1].frames + 100.0)
    with pytest.raises(ValueError, match=r"camera 'middle' overlaps with no other: 'left' 0 to 0\.79 s"):
        track_detections([tracking.detections[0], late, tracking.detections[2]], RIG)
    again = replace(RIG[1], time_offset=100.0)
    assert len(track_detections([tracking.detections[0], late], [RIG[0], again]).balls) == 1


# --- the files -----------------------------------------------------------------------------------------------------


def test_the_dataset_reads_back(tracking: Tracking, tmp_path: Path) -> None:
    out = tmp_path / "shots"
    written = write_tracking(out, tracking, INFO)
    assert set(written) == {path.name for path in out.iterdir()} == WRITTEN
    (track,) = read_dataset(out)
    assert np.array_equal(track.positions, tracking.balls[0].points)
    assert np.array_equal(track.sigmas, tracking.tracks[0].sigmas)
    for was, now in zip(RIG, read_cameras(out / "cameras.yaml"), strict=True):
        assert (now.name, now.size) == (was.name, was.size)
        assert np.array_equal(now.rvec, was.rvec)


def test_all_candidates_are_kept_and_the_balls_own_are_named(tracking: Tracking, tmp_path: Path) -> None:
    write_tracking(tmp_path / "shots", tracking, INFO)
    table = rows(tmp_path / "shots" / "detections.csv")
    assert len(table) == sum(len(detections) for detections in tracking.detections)
    named = [row for row in table if row["trajectory"] == "000"]
    assert len(named) == len(tracking.balls[0].sightings)
    assert {row["trajectory"] for row in table} == {"", "000"}
    assert min(float(row["score"]) for row in named) == 0.9
    assert all(float(row["sigma_u"]) == pytest.approx(SIGMA) and float(row["rho_uv"]) == 0.0 for row in named)
    middle = [row for row in named if row["camera"] == "middle"]
    pixels = np.array([[float(row["u"]), float(row["v"])] for row in middle])
    assert np.array_equal(pixels, tracking.seen(tracking.balls[0], 1)[1])


def test_no_ball_gives_an_empty_dataset_and_the_best_scores(empty: Tracking, tmp_path: Path) -> None:
    assert empty.balls == ()
    assert empty.agreement is None
    out = tmp_path / "empty"
    write_tracking(out, empty, INFO)
    assert (out / "tracks.csv").read_text() == "trajectory,t,x,y,z,sigma_x,sigma_y,sigma_z\n"
    assert len(rows(out / "detections.csv")) == 3 * 2 * FRAMES
    with pytest.raises(ValueError, match="must hold tracks; got a header without rows"):
        read_dataset(out)
    assert "left: 0.35, 0.35, 0.35 in 80 frames; middle" in no_ball(empty)
    blind = replace(empty, detections=(Detections.of_frames("left", []), *empty.detections[1:]))
    assert "left: no candidate in 0 frames" in no_ball(blind)


def test_what_cannot_be_finished_leaves_nothing(tracking: Tracking, tmp_path: Path) -> None:
    def broken() -> Iterator[tuple[float, Image]]:
        yield 0.0, np.zeros((360, 640, 3), np.uint8)
        raise OSError("disk gone")

    with pytest.raises(OSError, match="disk gone"):
        write_tracking(tmp_path / "shots", tracking, INFO, streams=[broken] * 3)
    assert list(tmp_path.iterdir()) == []


def test_an_earlier_result_is_replaced_as_a_whole(tracking: Tracking, empty: Tracking, tmp_path: Path) -> None:
    out = tmp_path / "shots"
    write_tracking(out, tracking, INFO)
    (out / "overlay.mp4").write_bytes(b"old")
    with pytest.raises(ValueError, match=r"holds an earlier result\. Replace it with --force"):
        check_result_folder(out, [], force=False)
    check_result_folder(out, [], force=True)
    write_tracking(out, empty, INFO)
    assert {path.name for path in out.iterdir()} == WRITTEN


def test_a_folder_in_which_something_would_be_lost_is_refused(tmp_path: Path) -> None:
    check_result_folder(tmp_path / "new", [], force=False)
    with pytest.raises(FileNotFoundError, match="must be in an existing folder"):
        check_result_folder(tmp_path / "no" / "new", [], force=False)
    read = tmp_path / "detections.csv"
    read.write_text("")
    with pytest.raises(ValueError, match="must be a folder"):
        check_result_folder(read, [], force=True)
    with pytest.raises(ValueError, match="must not hold what is read"):
        check_result_folder(tmp_path, [read], force=True)
    with pytest.raises(ValueError, match="holds other files"):
        check_result_folder(tmp_path, [], force=True)


def test_the_example_of_the_docs_runs(tracking: Tracking, capsys: pytest.CaptureFixture[str]) -> None:
    guide = (DOCS / "track.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", guide, re.DOTALL)
    exec(code, {"detections": tracking.detections, "cameras": RIG})
    said = capsys.readouterr().out
    assert said.startswith("000 [0.2 ")
    assert "The cameras agree" in said


def test_the_summary_counts(tracking: Tracking) -> None:
    lines = list(summary(tracking))
    used = len(tracking.rows(tracking.balls[0], 0))
    assert lines[0] == f"  left: 80 frames, 200 candidates, {used} of them a ball"


# --- a detector of one's own ---------------------------------------------------------------------------------------

DETECTOR = """
import numpy as np
from ballfg.vision.detection.detections import Candidates

LEVEL = 200

def find(image):
    rows, columns = np.nonzero(image.min(axis=2) > LEVEL)
    if len(rows) == 0:
        return Candidates.none()
    return Candidates.at([[columns.mean(), rows.mean()]], sigma=0.3)
"""


def filmed(folder: Path, images: list[Image]) -> Video:
    """A camera's folder of images, stamped 0.00, 0.01, ... s."""
    folder.mkdir()
    for number, image in enumerate(images):
        assert cv2.imwrite(str(folder / f"{number}.png"), image)
    stamps = folder.with_name(f"{folder.name}.csv")
    stamps.write_text("t\n" + "".join(f"{number / RATE}\n" for number in range(len(images))))
    return open_video(folder, stamps)


def test_a_class_is_a_detector_for_each_camera(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(DETECTOR + "class Finder:\n    __call__ = staticmethod(find)\n")
    make = load_detector(f"{file}:Finder")
    video = filmed(tmp_path / "left", [np.zeros((20, 30, 3), np.uint8)])
    assert make(video) is not make(video)
    assert len(make(video)(np.zeros((20, 30, 3), np.uint8))) == 0


def test_a_detector_from_a_file_works_here_and_in_other_processes(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(DETECTOR)
    make = load_detector(f"{file}:find")
    image = np.zeros((20, 30, 3), np.uint8)
    image[4:7, 10:13] = 255
    video = filmed(tmp_path / "left", [image])
    find = make(video)
    assert find(image).pixels == pytest.approx(np.array([[11.0, 5.0]]))
    there = pickle.loads(dumps(make))(video)  # as joblib sends it
    assert np.array_equal(there(image).pixels, find(image).pixels)


@pytest.mark.parametrize(
    ("text", "content", "message"),
    [
        ("mine.py", DETECTOR, "must be FILE.py:NAME; got"),
        ("no.py:find", DETECTOR, "does not exist"),
        ("mine.py:fnd", DETECTOR, "must define the callable 'fnd'; it is not defined there.*Did you mean 'find'"),
        ("mine.py:LEVEL", DETECTOR, "it is not callable"),
        ("mine.py:find", "a = 1\nb = a / 0\n", "line 2: ZeroDivisionError"),
        ("mine.py:find", "a = (\n", "line 1: SyntaxError"),
    ],
)
def test_a_detector_that_cannot_be_had(tmp_path: Path, text: str, content: str, message: str) -> None:
    (tmp_path / "mine.py").write_text(content)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        load_detector(f"{tmp_path}/{text}")


# --- detections from a table ---------------------------------------------------------------------------------------


def test_the_table_written_is_the_table_read(tracking: Tracking, tmp_path: Path) -> None:
    write_tracking(tmp_path / "shots", tracking, INFO)
    read, notes = read_detections(tmp_path / "shots" / "detections.csv", RIG)
    assert notes == []
    for was, now in zip(tracking.detections, read, strict=True):
        assert np.array_equal(was.times, now.times)
        assert np.array_equal(was.pixels, now.pixels)
        assert np.array_equal(was.scores, now.scores)
        assert was.covariances == pytest.approx(now.covariances)
    again = track_detections(read, RIG)
    assert np.array_equal(again.balls[0].times, tracking.balls[0].times)
    assert again.balls[0].points == pytest.approx(tracking.balls[0].points, abs=1e-9)


def test_a_table_of_four_columns_in_any_order_is_enough(tmp_path: Path) -> None:
    path = tmp_path / "detections.csv"
    path.write_text("camera,v,u,t,blur\nright,2,1,0.5,9\nleft,4,3,0.1,9\nright,6,5,0.25,9\nright,8,7,0.5,9\n")
    (left, right), notes = read_detections(path, [RIG[0], RIG[2]])
    assert notes == ["detections.csv: column 'blur' ignored"]
    assert left.pixels.tolist() == [[3.0, 4.0]]
    assert right.frames.tolist() == [0.25, 0.5]
    assert right.frame.tolist() == [0, 1, 1]
    assert right.pixels.tolist() == [[5.0, 6.0], [1.0, 2.0], [7.0, 8.0]]
    assert right.scores.tolist() == [1.0] * 3
    assert right.covariances[0].tolist() == [[0.25, 0.0], [0.0, 0.25]]
    assert right.radii[:, 0].tolist() == [0.0, 0.0, 0.0]


def test_a_table_may_hold_radii(tmp_path: Path) -> None:
    path = tmp_path / "detections.csv"
    path.write_text("t,camera,u,v,radius,sigma_radius\n0.1,left,1,2,4.5,0.2\n0.2,left,3,4,0,1\n")
    (left,), notes = read_detections(path, [RIG[0]])
    assert (left.radii.tolist(), notes) == ([[4.5, 0.2], [0.0, 1.0]], [])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("t,camera,u\n0,left,1\n", r"column 'v' is missing; expected t,camera,u,v, got 't,camera,u'\."),
        ("t,camera,u,v,u\n0,left,1,2,3\n", "column 'u' must appear once"),
        ("t,camera,u,v\n0,left,1,2\n0,lefty,1,2\n", "line 3, column 'camera'.*got 'lefty'.*Did you mean 'left'"),
        ("t,camera,u,v\n0,left,1,2\n0,right,one,2\n", "line 3, column 'u': must be a number"),
        ("t,camera,u,v\n0,left,1,2\n0,right,1,inf\n", "line 3, column 'v': must be finite, at most 1000000 px; got"),
        ("t,camera,u,v,score\n0,left,1,2,1\n\n0,right,1,2,1.5\n", "line 4, column 'score': must be 0 to 1; got 1.5"),
        ("t,camera,u,v,sigma_u\n0,left,1,2,0\n", "column 'sigma_u': must be 0.0001 to 1000000 px; got 0"),
        ("t,camera,u,v\n0,left,1,2\n", "every camera must have rows; got none of 'right'.*--without right"),
        ("t,camera,u,v\n", "every camera must have rows; got none of 'left' and 'right'"),
    ],
)
def test_a_bad_table_is_refused_with_its_place(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "detections.csv"
    path.write_text(content)
    with pytest.raises(ValueError, match=message):
        read_detections(path, [RIG[0], RIG[2]])


def test_rows_of_a_camera_that_is_left_out_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "detections.csv"
    path.write_text("t,camera,u,v\n0,left,1,2\n0,middle,1,2\n0,right,1,2\n")
    read, _ = read_detections(path, [RIG[0], RIG[2]], ["middle"])
    assert [detections.camera for detections in read] == ["left", "right"]
    with pytest.raises(FileNotFoundError, match="must be a table of detections; there is none"):
        read_detections(tmp_path / "no.csv", RIG)
