"""Problems that libraries solve in processes of their own, and the comparison with earlier times."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ballfg.benchmarks.cli import run
from ballfg.benchmarks.results import Results
from ballfg.benchmarks.speed.peers import suite
from ballfg.benchmarks.speed.peers.problem import Problem
from ballfg.benchmarks.speed.peers.suite import LibraryError, Session
from ballfg.benchmarks.speed.stopwatch import SlowerError, check_ratios


@pytest.fixture(scope="module")
def problem() -> Problem:
    whole = suite._problem(None)
    return replace(whole, measured=whole.measured[:2], label=whole.label[:2])


@pytest.mark.parametrize("kind", ["estimate", pytest.param("gradient", marks=pytest.mark.thorough)])
def test_libraries_meet_the_reference(problem, kind, tmp_path) -> None:
    task, results = suite.Task("A", kind, network=False, tracks=2, turns=1, runs=2), Results("test", 0)
    suite._run_task(results, task, problem, {name: [suite.sys.executable] for name in suite.OWN}, tmp_path)
    off, time = (results.value("A", "ballfg", metric) for metric in ("difference", "time"))
    assert off is not None
    assert time is not None
    assert off < suite.SAME
    assert time > 0.0
    if kind == "estimate":
        assert (results.value("A", "gtsam", "difference") or np.inf) < suite.SAME
        assert (results.value("A", "gtsam", "memory") or 0.0) > 10.0


def test_a_solution_that_differs_gets_no_time(problem, tmp_path, monkeypatch, capsys) -> None:
    task, results = suite.Task("A", "estimate", network=False, tracks=2, turns=1, runs=1), Results("test", 0)
    monkeypatch.setattr(suite, "SAME", 1e-30)
    suite._run_task(results, task, problem, {"ballfg": [suite.sys.executable]}, tmp_path)
    assert "away from the minimum" in capsys.readouterr().err
    with pytest.raises(KeyError):
        results.value("A", "ballfg", "time")


def test_a_library_that_is_not_there_says_so(problem, tmp_path) -> None:
    problem.save(tmp_path / "a.npz")
    with pytest.raises(LibraryError, match="jaxls"):
        Session([suite.sys.executable], "jaxls", "estimate", tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--peer", "jaxls"], "LIBRARY=PATH"),
        (["--peer", "jaxls=/nowhere"], "--peers"),
        (["--peers", "--peer", "jaxls=/nowhere"], "no file"),
        (["--peers", "--peer", "ceres=/bin/sh"], "must be of"),
        (["--gate", "nowhere.json"], "no file"),
    ],
)
def test_wrong_words(words, message, tmp_path, capsys) -> None:
    with pytest.raises(SystemExit) as end:
        run(["speed", *words, "--out", str(tmp_path / "out")])
    assert end.value.code == 2
    assert message in capsys.readouterr().err.replace("\n", " ")
    assert not (tmp_path / "out").exists()


def results_file(path: Path, control: float, lm: float) -> tuple[Results, Path]:
    results = Results("ballfg-bench speed", 0)
    results.add("speed", "analytic", "banded_time", "ms", control, 1)
    results.add("speed", "analytic", "lm_time", "ms", lm, 1)
    results.add("speed", "analytic", "lm_iterations", "1", 3, 1)
    path.mkdir()
    return results, results.write(path)


def test_times_are_compared_as_multiples_of_the_control(tmp_path) -> None:
    _, slow_machine = results_file(tmp_path / "before", control=2.0, lm=3.0)
    same, _ = results_file(tmp_path / "same", control=1.0, lm=1.6)
    (line,) = check_ratios(same.rows, slow_machine)
    assert "lm_time" in line
    worse, _ = results_file(tmp_path / "worse", control=1.0, lm=2.1)
    with pytest.raises(SlowerError, match="lm_time"):
        check_ratios(worse.rows, slow_machine)
    other = tmp_path / "other.json"
    other.write_text(json.dumps({"rows": []}))
    with pytest.raises(ValueError, match="shares none"):
        check_ratios(same.rows, other)
    other.write_text("[]")
    with pytest.raises(ValueError, match="is none"):
        check_ratios(same.rows, other)
