"""What the names of `import ballfg as bf` refuse, and what they note as doubtful."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ballfg as bf
from ballfg.tracks import write_dataset
from ballfg.tracks.info import DatasetInfo
from tests.commands import printed
from tests.front.my_shots import written


def test_arrays_in_place_of_a_track_are_told_how_to_be_one(shots: bf.Dataset, track: bf.Track) -> None:
    with pytest.raises(TypeError, match=r"track must be a Track; got ndarray. Make one with Track\(times, positions\)"):
        bf.Smoother(shots.ball, shots.table).estimate(track.positions)  # type: ignore[arg-type]
    for wrong in (track.positions, 3, [1.0, 2.0], (track.times,)):
        with pytest.raises(TypeError, match=f"measured must be a Track, .* or arrays; got {type(wrong).__name__}. Arr"):
            bf.estimate(wrong)  # type: ignore[call-overload]
    with pytest.raises(FileNotFoundError, match="nowhere"):
        bf.estimate("nowhere")
    with pytest.raises(
        ValueError, match=r"method must be one of smoother, online, ekf, sliding-window.*; got 'best'. Choose"
    ):
        bf.estimate(track, method="best")


@pytest.mark.parametrize("sort", [bf.Smoother, bf.Online, bf.ExtendedKalmanFilter])
def test_millimetres_and_milliseconds_are_refused(sort: type, track: bf.Track, shots: bf.Dataset) -> None:
    estimator = sort(shots.ball, shots.table)
    slow = bf.Track(1e3 * track.times, track.positions, name="slow")
    with pytest.raises(ValueError, match=r"track 'slow': t must be in s.* The unit is probably ms: divide by 1000"):
        estimator.estimate(slow)
    long = bf.Track(track.times, 1e3 * track.positions, name="long")
    with pytest.raises(ValueError, match="track 'long': x, y, z must be in m"):
        estimator.estimate(long)


SWAPPED = "the ball falls along y, not along z: exchange the axes so that z points up."
TABLE = "the ball bounces at z = 0.7"


def test_swapped_axes_and_a_wrong_table_are_noted(shots: bf.Dataset) -> None:
    whole = shots["000"]
    swapped = bf.Track(whole.times, whole.positions[:, [0, 2, 1]])
    below = bf.Track(whole.times, whole.positions)
    assert bf.estimate(whole).notes == ()
    right = bf.Settings.for_measured(bf.nominal_model(), position_noise=(0.003,) * 3)  # that of the simulation
    for method in ("smoother", "online", "ekf", "sliding-window"):
        found = bf.estimate(swapped, surfaces=shots.table, method=method, settings=right)
        assert found.notes[0] == SWAPPED
        (note,) = bf.estimate(below, surfaces=0.0, method=method, settings=right).notes
        assert note.startswith(TABLE)
        assert "where no surface is declared (they are at 0 and -0.76 m). Correct the table's height." in note


@pytest.mark.parametrize(("wrong", "said"), [("axes", SWAPPED), ("table", TABLE)])
def test_the_command_says_so_too(tmp_path: Path, shots: bf.Dataset, wrong: str, said: str) -> None:
    order, height = ([0, 2, 1], 0.76) if wrong == "axes" else ([0, 1, 2], 0.0)
    tracks = [replace(track, positions=track.positions[:, order], labels={}) for track in shots]
    (tmp_path / "data").mkdir()
    write_dataset(tmp_path / "data", replace(shots.info, table_height=height), tracks)
    words = ("estimate", tmp_path / "data", "--out", tmp_path / "states.csv", "--jobs", 1)
    found = printed(*words, status=3 if wrong == "axes" else 0)  # no ball flies along a table as fast as that
    assert f"note: track '000': {said}" in found.err


def test_a_track_that_was_changed_is_refused_by_every_estimator() -> None:
    changed = bf.Track([0.0, 0.01, 0.02], np.zeros((3, 3)), name="mine")
    changed.positions[1, 2] = np.nan
    for method in ("smoother", "online", "ekf", "sliding-window"):
        with pytest.raises(ValueError, match="track 'mine': times and positions must be finite; they were"):
            bf.estimate(changed, method=method)


def test_a_model_beside_the_data_is_offered_where_it_is_another(tmp_path: Path) -> None:
    folder = written(tmp_path / "shots", 1)
    path, model = folder / "model.yaml", bf.nominal_model()
    model.save(path)
    assert bf.read(folder).notes == []
    dict(model.named_parameters())["flight.drag.k"].data.fill_(0.15)
    model.save(path)
    offer = f"{path} lies beside the tracks and is not used. Give it as the model to use it."
    assert bf.read(folder).notes == [offer]
    for words, said in (([], True), (["--model", path], False)):
        found = printed("estimate", folder, "--out", tmp_path / "states.csv", "--jobs", 1, *words)
        assert (f"note: {offer}\n" in found.err) is said


@pytest.mark.parametrize("jobs", [0, -1, 10_001])
def test_fewer_processes_than_one_are_refused_everywhere(jobs: int, tmp_path: Path) -> None:
    """Before anything is read: the folder is not there."""
    for call in (bf.estimate, bf.predict, bf.diagnose, bf.error_budget):
        with pytest.raises(ValueError, match=rf"jobs must lie in 1 .. 10000; got {jobs}"):
            call(tmp_path / "nowhere", jobs=jobs)


@pytest.mark.parametrize("observe", [math.inf, -math.inf, math.nan, 0.0, -1.0])
def test_an_observed_part_is_a_positive_time(observe: float, tmp_path: Path) -> None:
    write_dataset(tmp_path, DatasetInfo("d", 0.0, bf.Ball(0.02, 0.0027), position_noise=0.003), [_fall()])
    with pytest.raises(ValueError, match="observe must be a positive number of seconds; got"):
        bf.predict(tmp_path, observe=observe)


@pytest.mark.parametrize(("measured", "got"), [(None, "nothing"), (3, "int"), ([], "list")])
def test_what_cannot_be_diagnosed_is_told_as_what_it_is(measured: object, got: str) -> None:
    with pytest.raises(TypeError, match=f"measured must be a dataset or its folder; got {got}. Read one with bf.read"):
        bf.diagnose(measured)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="got one Track; effects show in many of them"):
        bf.error_budget(_fall())  # type: ignore[arg-type]


def _fall() -> bf.Track:
    t = np.arange(20) / 100.0
    return bf.Track(t, np.column_stack([t, 0.0 * t, 1.2 - 4.9 * t**2]))
