import os
from dataclasses import replace

import numpy as np
import pytest

from ballfg.tracks import Track, read_dataset, write_dataset


@pytest.mark.parametrize("file_format", ["csv", "parquet"])
@pytest.mark.parametrize("sigmas", [False, True])
def test_round_trip_is_exact(tmp_path, info, make_tracks, file_format, sigmas):
    tracks = make_tracks(5, sigmas=sigmas)
    write_dataset(tmp_path / "d", info, (track for track in tracks), file_format)
    dataset = read_dataset(tmp_path / "d")
    assert dataset.info == info
    assert dataset.notes == []
    assert sorted(entry.name for entry in dataset.path.iterdir()) == [
        "dataset.yaml", "labels.csv", f"tracks.{file_format}",
    ]  # fmt: skip
    for wrote, read in zip(tracks, dataset, strict=True):
        assert read.name == wrote.name
        assert read.times.tobytes() == wrote.times.tobytes()
        assert read.positions.tobytes() == wrote.positions.tobytes()
        assert read.labels == wrote.labels
        assert (read.sigmas is None) == (not sigmas)
        if sigmas:
            assert read.sigmas.tobytes() == wrote.sigmas.tobytes()


def test_labels_may_differ_from_track_to_track(tmp_path, info, make_tracks):
    one, two, three = make_tracks(3)
    tracks = [replace(one, labels={"speed": 3.0}), replace(two, labels={}), replace(three, labels={"note": 'a, "b"'})]
    write_dataset(tmp_path / "d", info, tracks)
    dataset = read_dataset(tmp_path / "d")
    assert [track.labels for track in dataset] == [{"speed": 3.0}, {}, {"note": 'a, "b"'}]
    assert dataset.notes == ["labels.csv: 1 of 3 trajectories unlabelled"]


def test_names_that_need_quotes_come_back(tmp_path, info, make_tracks):
    tracks = [replace(track, name=name) for track, name in zip(make_tracks(3), ["a,b", '"', "é 1"], strict=True)]
    write_dataset(tmp_path / "d", info, tracks)
    assert read_dataset(tmp_path / "d").names == ["a,b", '"', "é 1"]


def test_an_older_dataset_is_replaced_and_other_files_stay(tmp_path, info, make_tracks):
    folder = tmp_path / "d"
    write_dataset(folder, info, make_tracks(3), "csv")
    (folder / "LICENSE").write_text("keep")
    write_dataset(folder, info, [replace(track, labels={}) for track in read_dataset(folder)], "parquet")
    assert sorted(entry.name for entry in folder.iterdir()) == ["LICENSE", "dataset.yaml", "tracks.parquet"]
    assert len(read_dataset(folder)) == 3


def test_a_dataset_can_be_rewritten_from_itself(tmp_path, info, make_tracks):
    write_dataset(tmp_path, info, make_tracks(3))
    write_dataset(tmp_path, info, (track.until(track.times[4]) for track in read_dataset(tmp_path)))
    assert [len(track) for track in read_dataset(tmp_path)] == [5, 5, 5]


@pytest.mark.parametrize("file_format", ["csv", "parquet"])
@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_exception_leaves_nothing(tmp_path, info, make_tracks, file_format, error):
    def broken():
        yield from make_tracks(600, 150)
        raise error

    with pytest.raises(error):
        write_dataset(tmp_path / "d", info, broken(), file_format)
    assert list(tmp_path.iterdir()) == []


def test_an_exception_leaves_the_older_dataset(tmp_path, info, make_tracks):
    write_dataset(tmp_path, info, make_tracks(3))
    before = {entry.name: entry.read_bytes() for entry in tmp_path.iterdir()}

    def broken():
        yield from make_tracks(2)
        raise RuntimeError

    with pytest.raises(RuntimeError):
        write_dataset(tmp_path, info, broken(), "parquet")
    assert {entry.name: entry.read_bytes() for entry in tmp_path.iterdir()} == before


TIMES = np.arange(3) / 100
FAST = Track(TIMES, np.array([[0, 0, 0], [100, 0, 0], [200, 0, 0]]), name="fast")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda tracks: [], "tracks must hold at least one track; got none."),
        (lambda tracks: [*tracks, tracks[0]], "track names must be unique; got '000' twice. Rename one of them."),
        (lambda tracks: [tracks[0].until(tracks[0].times[0])], "track '000' must have at least two samples; got one."),
        (
            lambda tracks: [replace(FAST, sigmas=np.full((3, 3), 1e-12))],
            "track 'fast': sigmas must be 1e-09 to 1e+06 m",
        ),
        (lambda tracks: [*tracks, FAST], "track 'fast': x, y, z must be in m and t in s; got a median speed of 1e+04"),
        (
            lambda tracks: [*tracks, Track(TIMES, np.zeros((3, 3)), np.ones((3, 3)), name="s")],
            "tracks must have sigmas all or none; 's' differs from the first.",
        ),
    ],
)
def test_tracks_that_could_not_be_read_are_refused(tmp_path, info, make_tracks, change, message):
    with pytest.raises(ValueError, match=r".") as caught:
        write_dataset(tmp_path / "d", info, change(make_tracks(2)))
    assert message in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_bad_arguments_are_named(tmp_path, info, make_tracks):
    with pytest.raises(ValueError, match="file_format must be one of csv, parquet; got 'hdf5'"):
        write_dataset(tmp_path / "d", info, make_tracks(1), "hdf5")
    with pytest.raises(FileNotFoundError, match=r"folder must be in an existing folder; .*nowhere is none"):
        write_dataset(tmp_path / "nowhere" / "d", info, make_tracks(1))
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match=r"folder must be a folder; .*file is a file"):
        write_dataset(tmp_path / "file", info, make_tracks(1))


def test_files_have_the_usual_permissions(tmp_path, info, make_tracks):
    (tmp_path / "plain").touch()
    write_dataset(tmp_path / "d", info, make_tracks(1))
    usual = os.stat(tmp_path / "plain").st_mode
    assert {os.stat(entry).st_mode for entry in (tmp_path / "d").iterdir()} == {usual}
