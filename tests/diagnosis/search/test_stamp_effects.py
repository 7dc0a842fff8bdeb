"""What is wrong with stamps becomes effects of the model that a fit begins with, and findings with their evidence.

How far stamps that count kept frames are off is known, and predictions from them have that as noise.
"""

from __future__ import annotations

import csv
import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ballfg.diagnosis import diagnose
from ballfg.diagnosis.budget import EXPECTED
from ballfg.diagnosis.error_budget import error_budget
from ballfg.diagnosis.fit.effects import with_effects
from ballfg.diagnosis.fit.holdout import hold_out
from ballfg.diagnosis.fit.stamps import Evidence, Stamps
from ballfg.diagnosis.report.wording import in_plain_words
from ballfg.diagnosis.search.stamp_effects import (
    as_declared,
    first_fit,
    noise_of_all_frames,
    stamp_findings,
    stamp_hypotheses,
    with_all_frames,
    with_errors_of_counting,
)
from ballfg.dynamics import EFFECTS, load_model
from ballfg.dynamics.effects.measurement import CountedFrames, TimeScale
from ballfg.simulation import SimulationConfig, write_simulation
from ballfg.tracks import Ball, Track, read_dataset, write_dataset
from ballfg.tracks.info import DatasetInfo
from ballfg.tracks.noise import TrackNoise
from ballfg.tracks.track import SPIN_LABELS

EACH = (Evidence(0.5, 1e-9, 0.8), Evidence(0.4, 1e-5, 0.6))
"""On the search half, on the other half."""


@pytest.mark.parametrize(
    ("found", "named"),
    [
        ((), {}),
        (("counted_frames",), {"counted_frames": ("missing",)}),
        (("time_scale",), {"time_scale": ("s",)}),
        (("counted_frames", "time_scale"), {"counted_frames": (), "time_scale": ("s",)}),
    ],
)
def test_counted_frames_are_held_where_a_clock_is_fitted(found: tuple[str, ...], named: dict[str, tuple]) -> None:
    stamps = Stamps(missing=0.25, scale=0.3, found=dict.fromkeys(found, EACH))
    hypotheses = stamp_hypotheses(stamps)
    assert {h.name: tuple(h.strengths) for h in hypotheses} == named
    assert {name: value for h in hypotheses for name, value in h.shape.items()} == (
        {"missing": 0.25} if len(found) > 1 else {}
    )


@pytest.mark.parametrize(("s", "words"), [(0.3, "30 %"), (1.0, "100 %")])
def test_the_first_fit_finds_how_far_the_clock_is_off(
    make_ball, make_launches, make_shots, tmp_path: Path, s: float, words: str
) -> None:
    clock = {"s": s}
    written = make_shots(make_ball(time_scale=clock), make_launches(16, 3), 3).stretches
    stamps = Stamps(
        scale=0.97 * (1.0 + s) - 1.0, found={"time_scale": EACH}
    )  # as the fall of the balls tells it, roughly
    write_simulation(tmp_path / "any", SimulationConfig(tracks=6, rate=60.0, seed=3))
    holdout = hold_out(read_dataset(tmp_path / "any"), make_ball(), 1, lambda line: None)
    fit = first_fit(make_ball(), replace(holdout, search=written, stamps=stamps))
    (free,) = (name for name in fit.problem.free if name.endswith("time_scale.s"))
    assert fit.unknowns.values[free] == pytest.approx(s, abs=0.01)
    (finding,) = stamp_findings(fit, stamps, fit)
    assert finding.parameters["s"].value == fit.unknowns.values[free]
    assert in_plain_words(finding) == f"The clock is wrong: durations are written {words} too long."
    assert (finding.name, finding.kind, finding.p_value) == ("time_scale", "measurement", 1e-9)
    assert (finding.held_out_gain, finding.held_out_p) == (0.6, 1e-5)
    assert finding.delta_bic == pytest.approx(math.log(16) - 2.0 * 16 * 0.8)
    assert np.isfinite(fit.cost)


def test_the_declared_model_has_no_effects_on_stamps(make_ball) -> None:
    model = with_effects(make_ball(), CountedFrames(missing=0.25), TimeScale(s=0.1))
    stamps = Stamps(0.25, {}, 0.1, {"counted_frames": EACH, "time_scale": EACH})
    bare = as_declared(model, stamps)
    assert [*bare.state_dict()] == [*make_ball().state_dict()]
    assert as_declared(model, Stamps()) is model


RATE, EVERY = 120.0, 10


def without_frames(folder: Path, lost: Callable[[int], bool]) -> None:
    """Drops frames of each track by their number; the stamps go on as if none were."""
    with (folder / "tracks.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    with (folder / "tracks.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        for _, own in itertools.groupby(rows, key=lambda row: row["trajectory"]):
            kept = [row for frame, row in enumerate(own) if not lost(frame)]
            writer.writerows({**row, "t": number / RATE} for number, row in enumerate(kept))


@pytest.fixture(scope="module")
def shots(tmp_path_factory):
    """Twelve shots of which every tenth frame is lost; the stamps go on as if none were."""
    folder = tmp_path_factory.mktemp("counted") / "shots"
    write_simulation(folder, SimulationConfig(tracks=12, rate=RATE, seed=4))
    without_frames(folder, lambda frame: frame % EVERY == EVERY - 1)
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


def test_flights_are_checked_with_all_frames(shots):
    """Their stamps are corrected, so that of jitter only what the file states is left."""
    dataset, model = shots
    halves = hold_out(dataset, model)
    checked = with_all_frames(with_errors_of_counting(halves), dataset)
    whole = {track.name: track for track in halves.tracks}
    for part in (*checked.search_tracks, *checked.held_out_tracks):
        track = whole[part.track.name]
        kept = [np.flatnonzero((track.positions == place).all(axis=1))[0] for place in part.track.positions]
        np.testing.assert_allclose(part.track.times, track.seconds[kept], atol=1e-12)
    assert checked.dataset.info.noise is None
    found = TrackNoise(position=(0.003,) * 3, memory=(0.002,) * 3, memory_time=0.02, stamp_jitter=0.0024)
    own = noise_of_all_frames(found, halves.stamps, dataset)
    assert (own.memory, own.stamp_jitter) == (found.memory, None)
    assert noise_of_all_frames(replace(found, memory=None, memory_time=None), halves.stamps, dataset) is None
    assert noise_of_all_frames(found, Stamps(), dataset) is found


def test_right_labels_are_not_accused_where_frames_are_lost(make_ball, make_launches, make_shots, tmp_path):
    """A fifth of the frames of balls at 4.5 to 6.5 m/s: with the stamps of the file nine of 16 labels seemed wrong."""
    rng, states = np.random.default_rng(4), make_launches(16, 4)
    states[:, 3:5] *= 1.3
    flown = make_shots(make_ball(), states, 4, rate=RATE).stretches
    tracks = []
    for name, places, label in zip(flown.names, flown.positions.numpy(), flown.labels.numpy(), strict=True):
        kept = places[rng.random(len(places)) > 0.2]
        labels = dict(zip(SPIN_LABELS, label.tolist(), strict=True))
        tracks.append(Track(np.arange(len(kept)) / RATE, kept, None, labels, name=name))
    info = DatasetInfo("lossy", 0.76, Ball(0.02, 0.0027), rate=RATE, position_noise=0.003, spin_noise=4.0)
    write_dataset(tmp_path / "lossy", info, tracks)
    found = diagnose(read_dataset(tmp_path / "lossy"), make_ball(), catalogue=[EFFECTS["wind"]])
    assert [finding.name for finding in found.findings] == ["counted_frames"]
    assert found.labels.contradicted == ()
