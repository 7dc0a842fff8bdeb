"""Stamps that count kept frames: how far they are off is known, and predictions from them have that as noise."""

from __future__ import annotations

import csv
import itertools
from dataclasses import replace

import numpy as np
import pytest

from ballfg.diagnosis.budget import EXPECTED
from ballfg.diagnosis.error_budget import error_budget
from ballfg.diagnosis.fit.holdout import hold_out
from ballfg.diagnosis.residual_tests.tracker_errors import in_the_fit, with_errors_of_counting
from ballfg.dynamics import load_model
from ballfg.simulation import SimulationConfig, write_simulation
from ballfg.tracks import read_dataset
from ballfg.tracks.noise import TrackNoise

RATE, EVERY = 120.0, 10


@pytest.fixture(scope="module")
def shots(tmp_path_factory):
    """Twelve shots of which every tenth frame is lost; the stamps go on as if none were."""
    folder = tmp_path_factory.mktemp("counted") / "shots"
    write_simulation(folder, SimulationConfig(tracks=12, rate=RATE, seed=4))
    with (folder / "tracks.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    with (folder / "tracks.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        for _, own in itertools.groupby(rows, key=lambda row: row["trajectory"]):
            kept = [row for frame, row in enumerate(own) if frame % EVERY != EVERY - 1]
            writer.writerows({**row, "t": number / RATE} for number, row in enumerate(kept))
    return read_dataset(folder), load_model(folder / "model.yaml")


def test_how_far_the_stamps_are_off_is_stated(shots):
    """With frames counted rightly: each kept frame falls a tenth of a frame further behind, until one is lost."""
    dataset, model = shots
    halves = hold_out(dataset, model)
    assert set(halves.stamps.found) == {"counted_frames"}
    kept = np.array([frame for frame in range(400) if frame % EVERY != EVERY - 1])
    right = {t.name: kept[: len(t)] * (1.0 - 1.0 / EVERY) / RATE for t in dataset}
    halves = replace(halves, stamps=replace(halves.stamps, missing=1.0 / (EVERY - 1.0), counted=right))
    stated = with_errors_of_counting(halves).dataset.info.noise
    sawtooth = np.arange(EVERY - 1) / EVERY
    assert stated.stamp_jitter == pytest.approx(np.std(sawtooth) / RATE, rel=0.05)
    assert dataset.info.noise is None


def test_good_stamps_get_no_error(shots, tmp_path):
    write_simulation(tmp_path / "even", SimulationConfig(tracks=6, rate=RATE, seed=3))
    halves = hold_out(read_dataset(tmp_path / "even"), shots[1])
    assert with_errors_of_counting(halves) is halves


def test_predictions_do_not_take_lost_frames_for_hits(shots):
    """At 3 to 6 m/s the stamps are off by 6 to 13 mm, more than all else: the noise is 3 mm."""
    budget = error_budget(*shots)
    assert budget.measured < 25.0
    assert max(EXPECTED, key=budget.squares.__getitem__) == "tracker"
    assert 0.5 < budget.measured / budget.floor < 1.5


def test_the_fit_has_all_frames(shots):
    """Its stamps are corrected, so that of jitter only what the file states is left."""
    found = TrackNoise(position=(0.003,) * 3, memory=(0.002,) * 3, memory_time=0.02, stamp_jitter=0.0024)
    own = in_the_fit(found, shots[0])
    assert (own.memory, own.stamp_jitter) == (found.memory, None)
    assert in_the_fit(TrackNoise(position=(0.003,) * 3, stamp_jitter=0.0024), shots[0]) is None
    assert in_the_fit(None, shots[0]) is None
