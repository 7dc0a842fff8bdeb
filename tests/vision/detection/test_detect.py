"""Videos through detectors: ours, one of your own, in processes, with progress; the example in the docs."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Iterable, Iterator
from concurrent.futures import Future
from pathlib import Path
from queue import SimpleQueue

import cv2
import numpy as np
import pytest

from ballfg.vision.detection.detect import _told, detect, detect_all, learn_detector
from ballfg.vision.detection.detections import Candidates, Detections
from ballfg.vision.detection.video import Video, open_video
from tests.places import DOCS
from tests.vision.drawn import Film

COUNT = 24


@pytest.fixture
def films(tmp_path: Path) -> dict[str, Path]:
    """Two cameras' videos."""
    paths = {}
    for seed, name in enumerate(("left", "right")):
        paths[name] = tmp_path / f"{name}.avi"
        film = Film(seed=seed)
        writer = cv2.VideoWriter(str(paths[name]), cv2.VideoWriter.fourcc(*"MJPG"), 120, film.size)
        for shot in film.shots(COUNT, 6.0):
            writer.write(shot.image)
        writer.release()
    return paths


def brightest(image: np.ndarray) -> Candidates:
    """The middle of what is nearly white."""
    rows, columns = np.nonzero(image.min(axis=2) > 240)
    return Candidates.at([[columns.mean(), rows.mean()]], 1.0) if len(rows) else Candidates.none()


def test_ball_is_detected_in_a_video(films: dict[str, Path]) -> None:
    video = open_video(films["left"])
    seen = detect(video, "left", learn_detector(video))
    truth = [shot.centre for shot in Film(seed=0).shots(COUNT, 6.0)]
    best = seen.select(seen.scores > 0.8)
    assert seen.camera == "left"
    np.testing.assert_allclose(seen.frames, np.arange(COUNT) / 120, atol=1e-6)
    errors = [np.hypot(*(pixel - truth[i])) for pixel, i in zip(best.pixels, best.frame, strict=True)]
    assert len({int(i) for i in best.frame}) >= COUNT - 1
    assert np.median(errors) < 0.15


@pytest.mark.parametrize("jobs", [1, 2])
def test_all_cameras_give_what_each_gives(films: dict[str, Path], jobs: int) -> None:
    told: list[int] = []

    def watch(frames: Iterable[int], total: int, what: str) -> Iterator[int]:
        assert (total, what) == (2 * COUNT, "frames searched")
        for number in frames:
            told.append(number)
            yield number

    found = detect_all(films, jobs=jobs, watch=watch)
    assert list(found) == ["left", "right"]
    assert len(told) == 2 * COUNT
    for name, path in films.items():
        alone = detect(open_video(path), name, learn_detector(open_video(path)))
        np.testing.assert_array_equal(found[name].pixels, alone.pixels)
        np.testing.assert_array_equal(found[name].scores, alone.scores)


def test_stamps_of_a_camera_come_from_its_file(films: dict[str, Path], tmp_path: Path) -> None:
    times = 5.0 + 0.01 * np.arange(COUNT)
    (tmp_path / "s.csv").write_text("t\n" + "\n".join(map(repr, times.tolist())), encoding="utf-8")
    found = detect_all(films, lambda video: brightest, stamps={"right": tmp_path / "s.csv"})
    np.testing.assert_array_equal(found["right"].frames, times)
    assert found["left"].frames[0] == 0.0


def test_a_camera_that_fails_in_its_process_says_why(films: dict[str, Path]) -> None:
    def fail(video: Video) -> None:
        raise ValueError(f"no detector for {video.name}")

    with pytest.raises(ValueError, match=r"no detector for (left|right)"):
        detect_all(films, fail, jobs=2)


def test_detector_must_give_candidates(films: dict[str, Path]) -> None:
    with pytest.raises(TypeError, match="a detector must return Candidates; got list for frame 0"):
        detect(open_video(films["left"]), "left", lambda image: [(1.0, 2.0)])


def test_nothing_seen_is_an_empty_recording(films: dict[str, Path]) -> None:
    seen = detect(open_video(films["left"]), "left", lambda image: Candidates.none())
    assert (len(seen), len(seen.frames), len(seen.best_scores())) == (0, COUNT, 0)


def test_example_in_the_docs_runs(
    films: dict[str, Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (DOCS / "detect.md").read_text(encoding="utf-8")
    examples = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(examples) == 2
    monkeypatch.chdir(films["left"].parent)
    for example in examples:
        exec(compile(example, "docs/detect.md", "exec"), {"__name__": "docs"})
    assert f"{COUNT} frames" in capsys.readouterr().out


@pytest.mark.thorough  # a quicker one: tests/parallel/test_stream.py
def test_a_process_that_dies_ends_the_search(films: dict[str, Path]) -> None:
    def die(video: Video) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    with pytest.raises(ChildProcessError, match="3 died over a chunk"):
        detect_all(films, die, jobs=2)


def test_a_video_too_short_for_a_background_is_named(tmp_path: Path) -> None:
    path = tmp_path / "left.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 120, (64, 48))
    for _ in range(2):
        writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    with pytest.raises(ValueError, match="video 'left' must have at least 3 frames"):
        learn_detector(open_video(path))


def test_frames_are_counted_over_all_cameras_until_each_has_ended() -> None:
    told: SimpleQueue[int] = SimpleQueue()
    for done in (3, 2, 4):
        told.put(done)
    ended, failed = Future[Detections](), Future[Detections]()
    ended.set_result(Detections.of_frames("left", []))
    failed.set_exception(ValueError("no video"))
    assert list(_told(told, [ended, ended])) == list(range(9))
    with pytest.raises(ValueError, match="no video"):
        list(_told(told, [Future(), failed]))


def test_processes_tell_every_frame(films: dict[str, Path]) -> None:
    seen: list[int] = []

    def watch(items: Iterable[int], total: int, what: str) -> Iterator[int]:
        for item in items:
            seen.append(item)
            yield item

    detect_all(films, lambda video: brightest, jobs=2, watch=watch)
    assert seen == list(range(2 * COUNT))
