"""A dataset in two halves: which track is where, what is left out, what is cut off."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ballfg.diagnosis.fit.holdout import _chosen, hold_out, launcher_labels
from ballfg.dynamics import nominal_model
from ballfg.estimation.configure import dataset_settings
from ballfg.simulation import SimulationConfig, write_simulation
from ballfg.simulation.config import MeasurementNoise
from ballfg.tracks import Dataset, read_dataset, write_dataset

SHORT = {"topspin": [0, 1], "sidespin": [-1, 0, 1], "speed": [10, 12]}


def written(folder: Path, **changes: object) -> Dataset:
    config = SimulationConfig(tracks=8, rate=60.0, seed=3, settings=SHORT)
    write_simulation(folder, replace(config, **changes))
    return read_dataset(folder)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    noise = MeasurementNoise(outliers=0.03, outlier_size=0.2)
    return written(tmp_path_factory.mktemp("halves") / "shots", noise=noise)


@pytest.fixture(scope="module")
def split(dataset):
    said = []
    return hold_out(dataset, nominal_model(), 1, said.append), said


def test_every_second_track_finds_and_the_others_judge(split, dataset):
    holdout, said = split
    assert set(holdout.search.names) == set(dataset.names[::2])
    assert set(holdout.held_out.names) == set(dataset.names[1::2])
    assert [j.track.name for j in holdout.search_tracks] == dataset.names[::2]
    assert [j.track.name for j in holdout.held_out_tracks] == dataset.names[1::2]
    assert holdout.excluded == ()
    assert said == ["estimating 8 tracks"]


def test_noise_that_is_louder_than_stated_is_no_outlier(tmp_path):
    """Twice the noise that the dataset states: a gate at the stated one would leave out every tenth sample."""
    louder = written(tmp_path / "louder", noise=MeasurementNoise(position=0.006, dropout=0.0, outliers=0.0, jitter=0.0))
    info = replace(louder.info, position_noise=0.003)
    write_dataset(tmp_path / "misjudged", info, iter(louder), "csv")
    misjudged = hold_out(read_dataset(tmp_path / "misjudged"), nominal_model(), 1, lambda line: None)
    right = hold_out(louder, nominal_model(), 1, lambda line: None)
    assert int(misjudged.search.used.sum()) >= 0.99 * int(right.search.used.sum())
    stated = misjudged.search.sigmas[misjudged.search.used]
    assert torch.allclose(stated, torch.full_like(stated, 0.003), rtol=1e-9)


def test_outliers_have_no_part(split, dataset):
    holdout, _ = split
    truth = {track.name: track for track in dataset}
    for part in holdout.held_out_tracks:
        whole = truth[part.track.name]
        assert len(part.track) < len(whole)
        assert set(part.track.times) <= set(whole.times)
        jumps = np.abs(np.diff(part.track.positions, axis=0)).max()
        assert jumps < 0.15  # no more than 6 m/s over a frame and a dropped one; an outlier jumps by 0.2 m


def test_what_is_fitted_are_labelled_flights(split):
    holdout, _ = split
    for stretches in (holdout.search, holdout.held_out):
        first = np.array([stretches.names.index(n) for n in dict.fromkeys(stretches.names)])
        assert stretches.labelled[first].mean() >= 0.5  # an outlier as first sample takes the label with it
        assert (stretches.settings == 0.0).all()  # a label of its own tells more
        assert bool((stretches.used.sum(1) >= 10).all())


def test_bounces_of_judged_tracks_lie_in_them(split):
    holdout, _ = split
    for part in holdout.held_out_tracks:
        assert (np.diff(part.bounces) > 0).all()
        assert (part.bounces <= part.track.times[-1]).all()
    assert sum(len(j.bounces) for j in holdout.held_out_tracks) > 0


def test_too_few_tracks(tmp_path):
    few = written(tmp_path / "few", tracks=5)
    with pytest.raises(ValueError, match=r"at least 6 tracks, half to find with and half to judge by; got 5\. Record"):
        hold_out(few, nominal_model(), 1, lambda line: None)


def test_of_many_tracks_some_are_looked_at(dataset):
    tracks, excluded = _chosen(dataset, 6)
    assert len(tracks) == 6
    assert (tracks[0].name, tracks[-1].name) == (dataset.names[0], dataset.names[-1])
    assert excluded == ["of 8 tracks 6, evenly spread, were looked at"]


def test_launcher_labels(dataset, tmp_path):
    settings = dataset_settings(dataset, nominal_model())
    numbers = launcher_labels(dataset, list(dataset), settings)
    assert numbers.embedding.names == ("topspin", "sidespin", "speed")
    bare = [replace(track, labels={}) for track in dataset]
    assert launcher_labels(dataset, bare, settings).embedding.names == (f"group={dataset.info.name}",)
    groups = [replace(track, labels={"group": "ab"[i % 2]}) for i, track in enumerate(bare)]
    grouped = launcher_labels(dataset, groups, settings)
    assert grouped.embedding.names == ("group=a", "group=b")
    np.testing.assert_array_equal(grouped.settings(groups[1]), [0.0, 1.0])
