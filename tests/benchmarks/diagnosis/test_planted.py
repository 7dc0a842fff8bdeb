"""Judging what was planted in measured tracks: names, strengths, rows, the picture and the command."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ballfg.benchmarks.cli import run as bench
from ballfg.benchmarks.conclusions import conclusions
from ballfg.benchmarks.diagnosis.cases import Case
from ballfg.benchmarks.diagnosis.changes import CHANGES
from ballfg.benchmarks.diagnosis.data import measured_dataset
from ballfg.benchmarks.diagnosis.planted import TITLE, outcome_of, planted_cases, run_planted, strengths
from ballfg.benchmarks.diagnosis.record import Found, Ranked, Record, case_digest
from ballfg.benchmarks.diagnosis.suite import run_case
from ballfg.benchmarks.results import Results
from ballfg.simulation import SimulationConfig, write_simulation
from ballfg.tracks import Dataset
from tests.diagnosis.made_diagnosis import silent

Values = dict[str, tuple[float, float | None]]


def record(planted: dict[str, float] | None = None, tested: dict[str, Values] | None = None, **found: Values) -> Record:
    findings = tuple(Found(name, (), 1e-9, -50.0, values) for name, values in found.items())
    ranked = tuple(Ranked(name, 1.0, 0.5, None, "not needed", values) for name, values in (tested or {}).items())
    return Record("", "unexplained", findings, (ranked,), {}, {}, 50, 25, 1.0, planted or {})


TILT = {"x": 0.02, "y": 0.0}


def test_a_strength_is_the_change_against_the_set_as_it_was() -> None:
    before = record(frame_tilt={"x": (-0.008, 0.001), "y": (0.003, 0.001)})
    near = outcome_of("frame_tilt", before, record(TILT, frame_tilt={"x": (0.015, 0.001), "y": (0.003, 0.001)}))
    assert near.named
    assert near.changes["x"] == pytest.approx((0.023, np.sqrt(2) * 0.001))
    assert near.found  # 2.1 sigma
    assert near.ratio == pytest.approx((1.15, np.sqrt(2) * 0.05))
    aside = outcome_of("frame_tilt", before, record(TILT, frame_tilt={"x": (0.012, 0.001), "y": (0.009, 0.001)}))
    assert aside.ratio == pytest.approx((1.0, np.sqrt(2) * 0.05))  # the other axis does not count
    blown = record({"x": 0.36, "y": 0.48}, wind={"x": (0.41, 0.03), "y": (0.43, 0.04)})
    assert outcome_of("wind", record(), blown).ratio == pytest.approx((0.98333, np.hypot(0.03, 0.0533333)), abs=1e-4)
    far = outcome_of("frame_tilt", before, record(TILT, frame_tilt={"x": (0.02, 0.001), "y": (0.003, 0.001)}))
    assert (far.named, far.found) == (True, False)  # as if the set had been level


def test_an_effect_without_a_name_had_the_strength_of_its_last_score_test() -> None:
    before = record(tested={"frame_tilt": {"x": (-0.006, 0.0005), "y": (0.0, 0.0005)}})
    after = record(TILT, frame_tilt={"x": (0.014, 0.0005), "y": (0.0, 0.0005)})
    assert outcome_of("frame_tilt", before, after).found
    assert not outcome_of("frame_tilt", record(), after).found


def test_without_its_name_a_change_has_no_strength() -> None:
    for after in (record(TILT), record(TILT, table_tilt={"x": (0.02, 0.001), "y": (0.0, 0.001)})):
        outcome = outcome_of("frame_tilt", record(), after)
        assert (outcome.named, outcome.found, outcome.ratio) == (False, False, None)
    group = replace(record(TILT), found=(Found("table_tilt", ("frame_tilt",), 0.0, -9.0, {"x": (0.02, 0.01)}),))
    outcome = outcome_of("frame_tilt", record(), group)
    assert (outcome.named, outcome.found) == (True, False)
    assert outcome_of("frame_tilt", None, group).names is None


def test_errors_of_stamps_and_tracker_add_in_squares() -> None:
    before = record(stamp_jitter={"sigma": (0.0015, 0.0001)})
    after = record({"sigma": 0.002}, stamp_jitter={"sigma": (0.0025, 0.0001)})
    outcome = outcome_of("stamp_jitter", before, after)
    assert outcome.found
    assert outcome.changes["sigma"] == pytest.approx((0.002, 0.0001 * np.hypot(1.0, 0.6)))
    assert not outcome_of(
        "stamp_jitter", before, record({"sigma": 0.002}, stamp_jitter={"sigma": (0.0035, 1e-4)})
    ).found


def test_a_change_half_way_is_the_later_level_against_the_first() -> None:
    levels: Values = {"offset[from 000]": (-0.004, 0.0003), "offset[from 026]": (0.008, 0.0004)}
    assert strengths(levels)["offset"] == pytest.approx((0.012, 0.0005))
    outcome = outcome_of("table_height_drift", record(), record({"offset": 0.012}, table_height_drift=levels))
    assert outcome.found
    assert outcome.ratio == pytest.approx((1.0, 0.0005 / 0.012))


def test_a_frame_of_labels_is_right_as_a_whole() -> None:
    turned = {"xx": -1.0, "xy": 1.0, "yx": -1.0, "yy": -1.0}
    right: Values = {"xx": (0.0, 0.0), "xy": (1.0, 0.0), "yx": (-1.0, 0.0), "yy": (0.0, 0.0)}
    before = record(tested={"spin_label_frame": {"xx": (0.9, 0.001), "yy": (0.9, 0.001)}})  # it has no size
    assert outcome_of("spin_label_frame", before, record(turned, spin_label_frame=right)).found
    mirrored = right | {"yx": (1.0, 0.0)}
    assert not outcome_of("spin_label_frame", before, record(turned, spin_label_frame=mirrored)).found


def test_a_strength_without_a_standard_deviation_does_not_count() -> None:
    after = record({"s": 0.04}, time_scale={"s": (0.04, None)})
    outcome = outcome_of("time_scale", record(), after)
    assert (outcome.named, outcome.found) == (True, False)


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sets") / "shots"
    write_simulation(folder, SimulationConfig(tracks=10, seed=5, rate=60.0))
    return folder


def test_each_set_is_diagnosed_as_it_was_and_with_each_change(measured: Path) -> None:
    cases = list(planted_cases("shots", measured, 2, tuple(CHANGES), 8))
    assert [case.change for case in cases] == ["", *CHANGES]
    assert {case.most for case in cases} == {8}
    assert len({case_digest(case) for case in cases}) == len({case.name for case in cases}) == len(cases)


def test_a_diagnosis_gets_the_changed_tracks(measured: Path) -> None:
    asked = SimpleNamespace()

    def diagnose(dataset: Dataset, model: object, *, jobs: int) -> object:
        asked.tracks = list(dataset)
        return silent()

    was, tilted = planted_cases("shots", measured, 2, ("frame_tilt",), 8)
    assert run_case(was, diagnose).strengths == {}
    before = asked.tracks
    assert run_case(tilted, diagnose).strengths == TILT
    assert [track.name for track in asked.tracks] == [track.name for track in before]
    assert len(before) == 8
    turned = before[3].positions[:, 2] * np.cos(0.02) + before[3].positions[:, 1] * np.sin(0.02)
    np.testing.assert_allclose(asked.tracks[3].positions[:, 2], turned, atol=1e-12)


def test_a_run_makes_rows_and_a_picture(measured: Path, tmp_path: Path) -> None:
    made: list[str] = []

    def run(case: Case) -> Record:
        made.append(case.change)
        if case.change == "wind":
            raise ValueError("tracks must be longer")
        found: dict[str, Values] = (
            {} if case.change in ("", "scale") else {case.change: {"x": (0.02, 1e-3), "y": (0, 1)}}
        )
        return replace(record(TILT if case.change else None, **found), digest=case_digest(case))

    chosen, results = ("frame_tilt", "scale", "wind"), Results("test", 0)
    pictures = run_planted(results, [measured], tmp_path, chosen, None, 1, run)
    assert made == ["", "frame_tilt", "scale", "wind"]
    assert [picture.name for picture in pictures] == ["planted.png"]
    assert pictures[0].stat().st_size > 10_000
    assert results.value(TITLE, "named", "all") == pytest.approx(1 / 3)
    assert results.value(TITLE, "within 3 sigma", "shots") == pytest.approx(1 / 3)
    assert results.value(TITLE, "named", "frame_tilt") == 1.0
    assert results.value("shots", "named", "wind") == 0.0
    said = conclusions(TITLE, [row for row in results.rows if row.case == TITLE])
    assert said == ["of 3 changes 33 % were named, 33 % also with their strength."]
    assert results.value("shots", "change", "frame_tilt.x") == 0.02
    assert {row.unit for row in results.rows if row.metric == "frame_tilt.x"} == {"rad"}
    made.clear()
    run_planted(Results("test", 0), [measured], tmp_path, chosen, None, 1, run)
    assert made == ["wind"]  # what failed is tried again, nothing else


def test_the_same_seed_draws_the_same_errors(measured: Path) -> None:
    def stamps(seed: int) -> list[float]:
        case = list(planted_cases("shots", measured, seed, ("stamp_jitter",), 8))[1]
        return [float(track.times.sum()) for track in measured_dataset(case, measured)[0]]

    assert stamps(1) == stamps(1) != stamps(2)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--change", "frame"), "one of frame_tilt"),
        ((), "there are no measured sets"),
        (("--data", "no/such/folder"), "no/such/folder"),
    ],
)
def test_bad_words_are_one_line_and_status_2(
    words: tuple[str, ...],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("BALLFG_DATA", str(tmp_path / "empty"))
    with pytest.raises(SystemExit) as ended:
        bench(["planted", *words, "--out", str(tmp_path / "never")])
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.strip().count("\n") == 0
    assert not (tmp_path / "never").exists()


@pytest.mark.thorough
def test_jitter_is_named_and_measured_in_simulated_shots(tmp_path: Path) -> None:
    write_simulation(tmp_path / "shots", SimulationConfig(tracks=24, seed=5, rate=120.0))
    results = Results("test", 0)
    run_planted(results, [tmp_path / "shots"], tmp_path, ("stamp_jitter",), None, 1)
    assert results.value("shots", "named", "stamp_jitter") == 1.0
    assert results.value("shots", "change", "stamp_jitter.sigma") == pytest.approx(0.0025, rel=0.15)
