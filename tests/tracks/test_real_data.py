"""The measured tracks, where they are at hand: at ../shared/data from the project's root, or in $BALLFG_DATA."""

import numpy as np
import pytest

from ballfg.tracks import TABLE_TENNIS, read_dataset, write_dataset
from tests.places import DATA

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason=f"no measured tracks at {DATA}; set BALLFG_DATA")


@pytest.mark.parametrize(
    ("name", "tracks", "samples", "notes"),
    [
        ("aimy", 88, 12_251, []),
        ("ballgun", 52, 5_559, ["7 exact repeats dropped"]),
        ("robot_rallies", 50, 19_939, ["rows of 1 trajectory were not in time order: sorted ('018')"]),
        (
            "spindoe", 116, 7_717,
            ["2 stamps with different rows, up to 3.7 cm apart: averaged ('056' at t=0.429, '109' at t=1.45)"],
        ),
    ],
)  # fmt: skip
def test_all_of_it_loads(name, tracks, samples, notes):
    dataset = read_dataset(DATA / name)
    assert len(dataset) == len(list(dataset)) == tracks
    assert sum(len(track) for track in dataset) == samples
    assert dataset.notes == notes
    assert dataset.info.ball == TABLE_TENNIS


def test_labels_of_the_real_sets():
    aimy = read_dataset(DATA / "aimy")
    assert aimy.label_names == ["group", "wheel_top_left", "wheel_top_right", "wheel_bottom"]
    assert aimy.track("mn5008_no_spin-00").labels["wheel_bottom"] == 1200.0
    spindoe = read_dataset(DATA / "spindoe")
    assert all(track.spin_label is not None for track in spindoe)
    assert np.array_equal(spindoe.track("000").spin_label, [5.727, -185.725, 122.059])


def test_a_stamp_shared_by_two_rows_holds_their_mean():
    track = read_dataset(DATA / "spindoe").track("056")
    at = int(np.flatnonzero(track.times == 0.429)[0])
    assert np.allclose(track.positions[at], [-0.005, -1.6235, -0.284], atol=1e-12)


def test_a_copy_in_parquet_is_the_same(tmp_path):
    dataset = read_dataset(DATA / "spindoe")
    write_dataset(tmp_path / "copy", dataset.info, dataset, "parquet")
    copy = read_dataset(tmp_path / "copy")
    assert copy.info == dataset.info
    for one, other in zip(dataset, copy, strict=True):
        assert one.positions.tobytes() == other.positions.tobytes()
        assert one.labels == other.labels
