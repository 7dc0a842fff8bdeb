"""`ballfg track` as a user meets it: from videos or detections to a dataset, and what is refused."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from ballfg.simulation.cameras import table_rig
from ballfg.simulation.scene.config import SceneConfig
from ballfg.simulation.scene.recording import record, write_scene
from ballfg.tracks import read_dataset
from ballfg.vision.camera_file import read_cameras, write_cameras
from tests.commands import printed, refused, status
from tests.vision.filming import level

RATE = 100.0
SIZE = (320, 180)
SPAN = 0.5  # s


RIG = [level(name, turn, 2.5, 1.0, 0.5) for name, turn in (("left", -0.7), ("middle", 0.1), ("right", 0.8))]


def centre(times: np.ndarray) -> np.ndarray:
    """(n, 3) m, a throw over the table."""
    return np.column_stack((-0.8 + 3.2 * times, 0.1 * times, 0.9 + 1.8 * times - 4.905 * times**2))


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    path = tmp_path / "cameras.yaml"
    write_cameras(path, RIG)
    return path


def table(path: Path, ball: bool = True, late: Mapping[str, float] | None = None) -> Path:
    """Detections of the throw, or of nothing that moves like a ball; stamps of some cameras late by some seconds."""
    noise = np.random.default_rng(0)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("t", "camera", "u", "v", "sigma_u", "sigma_v", "score"))
        for model in RIG:
            for t in np.arange(0.0, SPAN, 1.0 / RATE):
                pixel = model.project(centre(np.array([t])))[0] if ball else noise.uniform((0, 0), SIZE)
                u, v = pixel + 0.1 * noise.normal(size=2)
                stamp = t + (late or {}).get(model.name, 0.0)
                writer.writerow((stamp, model.name, u, v, 0.1, 0.1, 0.8 if ball else 0.4))
    return path


# --- detections ----------------------------------------------------------------------------------------------------


def test_detections_become_a_dataset(rig: Path, tmp_path: Path) -> None:
    out = tmp_path / "shots"
    said = printed("track", table(tmp_path / "detections.csv"), "--cameras", rig, "--out", out)
    assert said.err == ""
    assert said.out.startswith(f"{out}: 1 track of 50 points; wrote dataset.yaml, tracks.csv, detections.csv")
    assert "  left: 50 frames, 50 candidates, 50 of them a ball" in said.out
    dataset = read_dataset(out)
    assert (dataset.info.name, dataset.info.table_height, dataset.info.rate) == ("shots", 0.76, 100.0)
    (track,) = dataset
    assert np.sqrt(((track.positions - centre(track.times)) ** 2).sum(axis=1).mean()) < 0.004
    assert cv2.imread(str(out / "contact_sheet.png")) is not None


def test_of_cameras_known_roughly_a_better_way_is_told(rig: Path, tmp_path: Path) -> None:
    loose = [replace(one, covariance=np.diag(np.square([1e-3] * 3 + [3e-3] * 3 + [3e-3]))) for one in RIG[:2]]
    write_cameras(rig, [*loose, RIG[2]])
    words = ("--cameras", rig, "--no-overlay")
    assert (
        "note: errors of cameras known roughly (left, middle) last in tracks.csv"
        in printed("track", table(tmp_path / "detections.csv"), *words, "--out", tmp_path / "rough").err
    )
    write_cameras(rig, RIG)
    assert printed("track", tmp_path / "detections.csv", *words, "--out", tmp_path / "exact").err == ""
    (rough,), (exact,) = ([one.sigmas for one in read_dataset(tmp_path / name)] for name in ("rough", "exact"))
    assert (np.median(rough, axis=0) > 1.5 * np.median(exact, axis=0)).any()


def test_what_describes_the_dataset_can_be_given(rig: Path, tmp_path: Path) -> None:
    out = tmp_path / "shots"
    words = ("--name", "throws", "--table-height", 0.1, "--ball", "tennis", "--without", "middle")
    assert status("track", table(tmp_path / "detections.csv"), "--cameras", rig, "--out", out, *words) == 0
    info = read_dataset(out).info
    assert (info.name, info.table_height, info.ball.radius) == ("throws", 0.1, 0.0335)
    assert info.source == "ballfg track detections.csv"
    assert "middle" not in (out / "cameras.yaml").read_text()


def test_late_stamps_are_found_and_written_with_the_cameras(rig: Path, tmp_path: Path) -> None:
    out, given = tmp_path / "shots", table(tmp_path / "detections.csv", late={"middle": 0.004})
    assert "  middle: stamps late by " in printed("track", given, "--cameras", rig, "--out", out, "--time-offsets").out
    by_name = {camera.name: camera for camera in read_cameras(out / "cameras.yaml")}
    assert by_name["left"].time_offset == 0.0
    assert by_name["middle"].time_offset == pytest.approx(0.004, abs=5e-4)
    assert by_name["right"].time_offset == pytest.approx(0.0, abs=5e-4)
    (track,) = read_dataset(out)
    assert np.sqrt(((track.positions - centre(track.times)) ** 2).sum(axis=1).mean()) < 0.004


def test_time_offsets_do_not_stand_in_for_a_turned_camera(rig: Path, tmp_path: Path) -> None:
    turn, _ = cv2.Rodrigues(np.radians([0.0, 0.0, 2.0]))
    rotation = turn @ RIG[1].rotation
    moved = replace(RIG[1], rvec=cv2.Rodrigues(rotation)[0].ravel(), tvec=-rotation @ RIG[1].centre)
    write_cameras(rig, [RIG[0], moved, RIG[2]])
    out = tmp_path / "shots"
    given = table(tmp_path / "detections.csv")
    said = printed("track", given, "--cameras", rig, "--out", out, "--time-offsets")
    assert "left as they were" in said.err
    assert "stamps late by" not in said.out
    assert all(camera.time_offset == 0.0 for camera in read_cameras(out / "cameras.yaml"))


def test_rows_that_stand_twice_count_once(rig: Path, tmp_path: Path) -> None:
    given = table(tmp_path / "detections.csv")
    lines = given.read_text().splitlines()
    given.write_text("\n".join([lines[0], *(line for line in lines[1:] for _ in range(2))]) + "\n")
    said = printed("track", given, "--cameras", rig, "--out", tmp_path / "shots")
    assert "1 track of 50 points" in said.out
    assert "150 exact repeats of rows dropped" in said.err


def test_stamps_in_milliseconds_are_refused(rig: Path, tmp_path: Path) -> None:
    given = table(tmp_path / "detections.csv")
    rows = [line.split(",", 1) for line in given.read_text().splitlines()]
    given.write_text("\n".join([",".join(rows[0]), *(f"{1000 * float(t)},{rest}" for t, rest in rows[1:])]) + "\n")
    assert "camera 'left': t must be in s, with a median step of 1e-06 to 1 s; got 10 s" in refused(
        "track", given, "--cameras", rig, "--out", tmp_path / "shots"
    )


def test_no_ball_says_how_good_the_best_were_and_leaves_an_empty_dataset(rig: Path, tmp_path: Path) -> None:
    out = tmp_path / "shots"
    given = table(tmp_path / "detections.csv", ball=False)
    said = refused("track", given, "--cameras", rig, "--out", out)
    assert (
        "no ball was found. Best candidates' scores (1 is a ball): left: 0.40, 0.40, 0.40 in 50 frames; middle" in said
    )
    assert "holds an empty dataset; look at contact_sheet.png there" in said
    assert "must hold tracks; got a header without rows" in refused("estimate", out, "--out", tmp_path / "states.csv")


def test_a_camera_that_was_turned_is_named(rig: Path, tmp_path: Path) -> None:
    nudge = cv2.Rodrigues(np.deg2rad([0.5, 0.0, 0.0]))[0]
    turned = cv2.Rodrigues(nudge @ RIG[1].rotation)[0].ravel()
    write_cameras(rig, [RIG[0], replace(RIG[1], rvec=turned, tvec=nudge @ RIG[1].tvec), RIG[2]])
    given = table(tmp_path / "detections.csv")
    assert printed("track", given, "--cameras", rig, "--out", tmp_path / "shots").err.startswith(
        "note: Camera middle has moved since its calibration"
    )


def test_bad_detections_are_refused(rig: Path, tmp_path: Path) -> None:
    given = table(tmp_path / "detections.csv")
    words = (given, "--cameras", rig, "--out", tmp_path / "shots")
    for options, message in (
        (("--stamps", "left=a.csv"), "--stamps must not be given with detections"),
        (("--colour", "white"), "--colour must not be given with detections"),
        (("--without", "lft"), "without must name a camera: left, middle, right; got 'lft'"),
        (tuple(word for name in ("left", "middle", "right") for word in ("--without", name)), "at least 2; got 0"),
        (("--without", "left", "--without", "right", "--time-offsets"), "--time-offsets needs two cameras"),
        (("--ball", "squash"), "ball must be "),
    ):
        assert message in refused("track", *words, *options)
    write_cameras(rig, RIG[:2])
    assert "line 102, column 'camera': must be a camera: left, middle; got 'right'" in refused("track", *words)
    assert not (tmp_path / "shots").exists()


def test_what_is_there_is_not_lost(rig: Path, tmp_path: Path) -> None:
    given = table(tmp_path / "detections.csv")
    out = tmp_path / "shots"
    words = (given, "--cameras", rig, "--out", out)
    assert "lies in" in refused("track", given, "--cameras", rig, "--out", tmp_path)
    assert status("track", *words) == 0
    before = (out / "tracks.csv").read_bytes()
    assert "Replace it with --force" in refused("track", *words)
    assert status("track", *words, "--force") == 0
    assert (out / "tracks.csv").read_bytes() == before


# --- videos --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two shots, the second while the first still flies, with everything else that moves in a room."""
    folder = tmp_path_factory.mktemp("track") / "scene"
    config = SceneConfig(shots=2, interval=0.7, seed=1, rate=60.0, settings={"speed": [9]})
    write_scene(folder, record(config, table_rig((640, 360))))
    return folder


@pytest.fixture
def one_view(tmp_path: Path) -> Path:
    """The same room and shots, filmed by one camera."""
    config = SceneConfig(shots=2, interval=0.7, seed=1, rate=60.0, settings={"speed": [9]})
    rig = [camera for camera in table_rig((640, 360)) if camera.name == "right"]
    write_scene(tmp_path / "scene", record(config, rig))
    return tmp_path / "scene"


@pytest.fixture(scope="module")
def tracked(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset of its videos."""
    out = tmp_path_factory.mktemp("tracked") / "shots"
    assert status("track", *videos(scene), "--out", out, "--jobs", 1) == 0
    return out


def videos(scene: Path) -> list[object]:
    words: list[object] = [scene / f"{name}.mp4" for name in ("left", "right", "far")]
    for name in ("left", "right", "far"):
        words += ["--stamps", f"{name}={scene}/{name}_stamps.csv"]
    return [*words, "--cameras", scene / "cameras.yaml"]


def numbers(path: Path, *columns: str) -> dict[str, np.ndarray]:
    """(n, k) of each trajectory."""
    found: dict[str, list[list[float]]] = {}
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            found.setdefault(row["trajectory"], []).append([float(row[name]) for name in columns])
    return {name: np.array(rows) for name, rows in found.items()}


@pytest.mark.thorough
def test_videos_become_the_tracks_that_were_flown(scene: Path, tracked: Path) -> None:
    truth = numbers(scene / "truth.csv", "t", "x", "y", "z")
    visible = numbers(scene / "visible.csv", "t_true")
    due, found = 0, 0
    tracks = list(read_dataset(tracked))
    assert len(tracks) == len(truth) == 2
    squares = []
    for track, (name, flown) in zip(tracks, truth.items(), strict=True):
        true = np.column_stack([np.interp(track.times, flown[:, 0], flown[:, axis]) for axis in (1, 2, 3)])
        squares.append(((track.positions - true) ** 2).sum(axis=1))
        times, views = np.unique(visible[name], return_counts=True)
        due += int((views >= 2).sum())
        found += int(np.isin(times[views >= 2].round(6), track.times.round(6)).sum())
    assert found >= 0.97 * due
    assert np.sqrt(np.concatenate(squares).max()) < 0.05  # no false point
    assert np.sqrt(np.concatenate(squares).mean()) < 0.005
    overlay = cv2.VideoCapture(str(tracked / "overlay.mp4"))
    assert int(overlay.get(cv2.CAP_PROP_FRAME_COUNT)) == len((scene / "left_stamps.csv").read_text().split()) - 1
    assert (overlay.get(cv2.CAP_PROP_FRAME_WIDTH), overlay.get(cv2.CAP_PROP_FRAME_HEIGHT)) == (1920, 360)


@pytest.mark.thorough
def test_states_and_predictions_of_what_was_filmed_agree_with_the_truth(
    scene: Path, tracked: Path, tmp_path: Path
) -> None:
    """The whole way: video, dataset, states straight from pixels, prediction from the first 0.3 s."""
    states, ahead = tmp_path / "states.csv", tmp_path / "ahead.csv"
    assert status("estimate", tracked, "--from", "detections", "--out", states, "--jobs", 1) == 0
    assert status("predict", tracked, "--observe", 0.3, "--out", ahead, "--jobs", 1) == 0
    truth = numbers(scene / "truth.csv", "t", "x", "y", "z", "vx", "vy", "vz")
    found = numbers(states, "t", "x", "y", "z", "vx", "vy", "vz", "sigma_vx", "sigma_vy", "sigma_vz")
    predicted = numbers(ahead, "t", "x", "y", "z", "sigma_x", "sigma_y", "sigma_z")
    for flown, seen, coming in zip(truth.values(), found.values(), predicted.values(), strict=True):
        velocity = at(flown, seen[:, 0])[:, 3:]
        steady = np.abs(velocity - at(flown, seen[:, 0] + 0.017)[:, 3:]).max(axis=1) < 0.5  # no bounce next to it
        steady &= np.abs(velocity - at(flown, seen[:, 0] - 0.017)[:, 3:]).max(axis=1) < 0.5
        error = (seen[:, 4:7] - velocity)[steady]
        assert np.sqrt((error**2).mean()) < 0.05
        assert np.median(np.abs(error / seen[steady, 7:])) < 1.5
        off = coming[:, 1:4] - at(flown, coming[:, 0])[:, :3]
        soon = coming[:, 0] < coming[0, 0] + 0.1
        assert np.linalg.norm(off[soon], axis=1).max() < 0.03
        assert np.median(np.abs(off / coming[:, 4:])) < 1.5


def test_one_camera_gives_states(one_view: Path, tmp_path: Path) -> None:
    scene, out, states = one_view, tmp_path / "shots", tmp_path / "states.csv"
    words = [scene / "right.mp4", "--stamps", f"right={scene}/right_stamps.csv", "--cameras", scene / "cameras.yaml"]
    said = printed("track", *words, "--out", out, "--jobs", 1).out
    wrote = "dataset.yaml, states.csv, events.csv, detections.csv, cameras.yaml, overlay.mp4, contact_sheet.png"
    assert f"wrote {wrote}" in said
    truth, found = (numbers(path, "t", "x", "y", "z") for path in (scene / "truth.csv", out / "states.csv"))
    assert len(truth) == len(found) == 2
    for flown, estimated in zip(truth.values(), found.values(), strict=True):
        error = estimated[:, 1:] - at(flown, estimated[:, 0])
        assert np.sqrt((error**2).sum(axis=1).mean()) < 0.08
    assert status("estimate", out, "--out", states, "--jobs", 1) == 0  # from the detections, without an option
    again, sigmas = numbers(states, "t", "x", "y", "z"), numbers(states, "t", "sigma_x", "sigma_y", "sigma_z")
    for name, estimated in found.items():  # each stroke has one bounce, from which both start
        np.testing.assert_array_less(np.abs(again[name] - estimated)[:, 1:], 0.02 * sigmas[name][:, 1:])
    rho = numbers(states, "t", "rho_xy", "rho_xz", "rho_yz")
    assert all((np.abs(one[:, 1:]) <= 1.0).all() and np.abs(one[:, 1:]).max() > 0.9 for one in rho.values())  # a ray
    assert status("show", out, states, "--out", tmp_path / "page.html") == 0
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert '"cameras":[{"name":"right"' in page.replace(" ", "")


def test_a_table_elsewhere_in_the_cameras_world_is_stated(one_view: Path, tmp_path: Path) -> None:
    """One camera, calibrated in a world with the origin on the table's middle: its ends are not those of ballfg's."""
    scene, out, rng = one_view, tmp_path / "shots", np.random.default_rng(0)
    shift = np.array([-1.37, 0.0, -0.76])
    (own,) = read_cameras(scene / "cameras.yaml")
    write_cameras(tmp_path / "cameras.yaml", [replace(own, tvec=own.tvec - own.rotation @ shift)])
    with (scene / "visible.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["camera"] == own.name and row["whole"] == "1"]
    with (tmp_path / "seen.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("t", "camera", "u", "v", "sigma_u", "sigma_v"))
        for row in rows:
            pixel = np.array([float(row["u"]), float(row["v"])]) + 0.3 * rng.standard_normal(2)
            writer.writerow((row["t"], own.name, *pixel.tolist(), 0.3, 0.3))
    words = (tmp_path / "seen.csv", "--cameras", tmp_path / "cameras.yaml", "--out", out, "--no-overlay")
    assert status("track", *words, "--table-height", 0, "--table", "x=-1.37..1.37, y=-0.7625..0.7625") == 0
    assert "x:\n    - -1.37\n    - 1.37\n    y:\n    - -0.7625\n" in (out / "dataset.yaml").read_text(encoding="utf-8")
    truth, found = (numbers(path, "t", "x", "y", "z") for path in (scene / "truth.csv", out / "states.csv"))
    assert len(truth) == len(found) == 2
    for flown, estimated in zip(truth.values(), found.values(), strict=True):
        error = estimated[:, 1:] - shift - at(flown, estimated[:, 0])
        assert np.sqrt((error**2).sum(axis=1).mean()) < 0.08


def at(flown: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Truth, sampled every millisecond, at other times."""
    return np.column_stack([np.interp(times, flown[:, 0], column) for column in flown[:, 1:].T])


def film(path: Path, size: tuple[int, int] = SIZE, frames: int = 20) -> Path:
    """A video of noise on grey."""
    noise = np.random.default_rng(1)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 50.0, size)
    for _ in range(frames):
        writer.write(noise.normal(110, 2, (size[1], size[0], 3)).clip(0, 255).astype(np.uint8))
    writer.release()
    return path


def stamps(path: Path, times: np.ndarray) -> Path:
    path.write_text("t\n" + "".join(f"{t}\n" for t in times))
    return path


def test_bad_videos_are_refused(rig: Path, tmp_path: Path) -> None:
    left, middle, right = (film(tmp_path / f"{model.name}.mp4") for model in RIG)
    out = tmp_path / "shots"
    words = ("--cameras", rig, "--out", out, "--jobs", 1)
    alone = refused("track", left, "--out", out, "--time-offsets")
    assert "--time-offsets must not be given without --cameras. Leave it out." in alone
    for text in ("2.74x1.525", "x=0..2.74", "x=0..2.7.4,y=-1..1"):
        said = refused("track", left, middle, right, *words, "--table", text)
        assert f"table must read x=LOW..HIGH,y=LOW..HIGH, m; got '{text}'. Write for instance" in said
    assert "frame.table.y must increase" in refused("track", left, middle, right, *words, "--table", "x=0..1,y=1..-1")
    assert "got none for 'middle'. Give it as middle=FILE, or leave the camera out with --without middle" in refused(
        "track", left, right, *words
    )
    assert "video 'side.mp4' must be of a camera: left, middle, right; got 'side'" in refused(
        "track", left, "side.mp4", *words
    )
    assert "does not exist" in refused("track", left, middle, f"right={tmp_path}/no.mp4", *words)
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(right.read_bytes()[:2000])
    assert "broken.mp4 must be a file that FFmpeg decodes" in refused("track", left, middle, f"right={broken}", *words)
    small = film(tmp_path / "small.mp4", (160, 90))
    other = refused("track", left, middle, f"right={small}", *words)
    assert "got 320x180 in the cameras' file and a video of 160x90" in other
    back = stamps(tmp_path / "back.csv", np.r_[np.arange(10), 8, np.arange(11, 20)] / 50.0)
    behind = refused("track", left, middle, right, *words, "--stamps", f"left={back}")
    assert "frame 10 has 0.16 s after 0.18 s" in behind
    later = stamps(tmp_path / "later.csv", 60.0 + np.arange(20) / 50.0)
    assert "camera 'right' overlaps with no other: 'left' 0 to 0.38 s; 'middle' 0 to 0.38 s; 'right' 60 to" in refused(
        "track", left, middle, right, *words, "--stamps", f"right={later}"
    )
    assert not out.exists()


def test_videos_without_a_ball_leave_pictures_to_look_at(rig: Path, tmp_path: Path) -> None:
    out = tmp_path / "shots"
    given = [film(tmp_path / f"{model.name}.mp4") for model in RIG]
    said = refused("track", *given, "--cameras", rig, "--out", out, "--jobs", 1)
    assert "no ball was found. Best candidates' scores (1 is a ball): left: no candidate in 20 frames" in said
    assert "look at overlay.mp4, contact_sheet.png there" in said
    assert (out / "tracks.csv").read_text().count("\n") == 1
    assert {path.name for path in out.iterdir()} >= {"dataset.yaml", "detections.csv", "overlay.mp4"}


def test_a_detector_that_fails_is_told_with_line_and_frame(rig: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("def find(image):\n    return 1 / 0\n")
    given = [film(tmp_path / f"{model.name}.mp4") for model in RIG]
    words = (*given, "--cameras", rig, "--out", tmp_path / "shots", "--detector", f"{tmp_path}/mine.py:find")
    said = refused("track", *words, "--jobs", 1)
    assert "mine.py must run as Python (frame 0 of left); line 2: ZeroDivisionError: division by zero" in said


def test_a_detector_of_ones_own_finds_what_it_looks_for(rig: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        "from ballfg.vision.detection.detections import Candidates\n"
        "def corner(image):\n"
        "    return Candidates.at([[5.0, 7.0]], sigma=0.3, scores=[0.25])\n"
    )
    given = [film(tmp_path / f"{model.name}.mp4") for model in RIG]
    words = (*given, "--cameras", rig, "--out", tmp_path / "shots", "--detector", f"{tmp_path}/mine.py:corner")
    assert "left: 0.25, 0.25, 0.25 in 20 frames" in refused("track", *words, "--no-overlay", "--jobs", 1)
    assert not (tmp_path / "shots" / "overlay.mp4").exists()
    assert "--colour must not be given with --detector" in refused("track", *words, "--colour", "orange", "--force")
