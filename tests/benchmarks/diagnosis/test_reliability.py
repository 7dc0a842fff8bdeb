"""Stated probabilities against counts that are drawn from them, and sets whose sizes are drawn as they should be."""

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import kstest

from ballfg.benchmarks.cli import run as bench
from ballfg.benchmarks.diagnosis.cases import Case
from ballfg.benchmarks.diagnosis.data import actual_model
from ballfg.benchmarks.diagnosis.record import Record, case_digest, record_of
from ballfg.benchmarks.diagnosis.suite import ALL, TITLE, add_reliability, reliability_cases, run_reliability
from ballfg.benchmarks.results import Results
from ballfg.dynamics import EFFECTS
from tests.diagnosis.made_diagnosis import found


def stated(probabilities: dict[str, float]) -> Record:
    return Record("", "effect found", (), (), {}, {}, 50, 25, 1.0, probabilities=probabilities)


def drawn(sharper: float, count: int = 400) -> Results:
    """Rows of sets whose effects are there with probability p; the logit that is stated is so many times sharper."""
    rng, cases, records = np.random.default_rng(4), list[Case](), dict[str, Record]()
    for number in range(count):
        true = {f"effect{i}": float(p) for i, p in enumerate(rng.uniform(0.0, 1.0, 5))}
        there = tuple(name for name, p in true.items() if rng.random() < p)
        cases.append(Case(TITLE, "drawn", 1.0, number, there))
        said = {name: 1.0 / (1.0 + (1.0 / p - 1.0) ** sharper) for name, p in true.items()}
        records[cases[-1].name] = stated(said)
    results = Results("test", 0)
    add_reliability(results, cases, records)
    return results


def inside(results: Results) -> list[bool]:
    rows = [row for row in results.rows if row.method.startswith("share right")]
    assert [row.metric for row in rows] == ["50-70 %", "70-90 %", "90-97 %", "97-100 %"]
    return [row.low <= row.value <= row.high for row in rows]  # type: ignore[operator]


def test_right_probabilities_are_within_the_band_and_sharper_ones_are_not() -> None:
    right, sharp = drawn(1.0), drawn(3.0)
    assert all(inside(right))
    assert right.value(TITLE, "calibration error", ALL) < 0.03  # type: ignore[operator]
    assert not any(inside(sharp)[1:])
    assert sharp.value(TITLE, "calibration error", ALL) > 0.1  # type: ignore[operator]


def test_bins_bands_and_the_error_of_a_handful() -> None:
    cases = [Case(TITLE, "few", 1.0, number, ("wind",)) for number in range(4)]
    said = [{"wind": 0.9, "scale": 0.6}, {"wind": 0.96}, {"wind": 0.3}]
    records = {case.name: stated(p) for case, p in zip(cases, said, strict=False)}
    results = Results("test", 0)
    add_reliability(results, cases, records)
    assert results.value(TITLE, "failed", ALL) == 1.0
    assert results.value(TITLE, "stated probability", "90-97 %") == pytest.approx(0.93)
    assert results.value(TITLE, "share right [chance allows]", "90-97 %") == 1.0
    assert results.value(TITLE, "share right [chance allows]", "50-70 %") == 0.0
    assert results.value(TITLE, "calibration error", ALL) == pytest.approx((2 * 0.07 + 0.6) / 3)


def test_without_probabilities_one_line_says_why_rows_are_missing(capsys: pytest.CaptureFixture[str]) -> None:
    case, results = Case(TITLE, "few", 1.0, 0), Results("test", 0)
    add_reliability(results, [case], {case.name: stated({})})
    assert [row.method for row in results.rows] == ["failed"]
    assert capsys.readouterr().err == "note: no reliability rows: the diagnoses state no probability\n"


def test_a_record_keeps_the_probabilities_that_a_diagnosis_states() -> None:
    diagnosis = replace(found(), probabilities={"wind": 0.98, "gust_region": 0.02})
    assert record_of(Case(TITLE, "one", 1.0, 0), "", diagnosis, None, 1.0).probabilities == diagnosis.probabilities


def test_sizes_are_log_uniform_and_numbers_even() -> None:
    cases = list(reliability_cases(400, 1))
    numbers = Counter(len(case.planted) for case in cases)
    assert set(numbers) == {0, 1, 2, 3}
    assert min(numbers.values()) > 70
    sizes = []
    for case in cases:
        assert len(set(case.planted)) == len(case.planted)
        for name, text in zip(case.planted, case.sessions[0], strict=True):
            usual, value = EFFECTS[name].usual, float(text.partition("=")[2])
            assert usual is not None
            coefficient = text.partition("=")[0].partition(".")[2]
            base = next(c.default for c in EFFECTS[name].coefficients if c.name == coefficient)
            if name not in ("gravity",):
                base = 0.0
            sizes.append((value - base) / usual.change[coefficient])
        assert case.recording.labels or not any(name.startswith("spin_label") for name in case.planted)
    assert kstest(np.log(sizes), "uniform", (math.log(0.2), math.log(25.0))).pvalue > 0.01
    assert cases[7] == next(case for case in reliability_cases(8, 1) if case.seed == 7)


def test_every_drawn_truth_is_a_model() -> None:
    for case in reliability_cases(60, 2):
        assert set(case.planted) <= {effect for group in groups(case) for effect in group}


def groups(case: Case) -> tuple[object, ...]:
    model = actual_model(case)
    return model.flight, model.bounce, model.measurement


def test_a_run_keeps_its_sets(tmp_path: Path) -> None:
    made: list[str] = []

    def run(case: Case) -> Record:
        made.append(case.name)
        return replace(stated(dict.fromkeys(case.planted, 0.95)), digest=case_digest(case))

    results = Results("test", 3)
    run_reliability(results, tmp_path, 6, 1, run)
    assert len(made) == 6
    assert results.value(TITLE, "share right [chance allows]", "90-97 %") == 1.0
    run_reliability(Results("test", 3), tmp_path, 6, 1, run)
    assert len(made) == 6


def test_measured_sets_have_no_known_effects(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        bench(["loop", "--reliability", "--data", str(tmp_path)])
    assert ended.value.code == 2
    assert "Leave out --data" in capsys.readouterr().err
