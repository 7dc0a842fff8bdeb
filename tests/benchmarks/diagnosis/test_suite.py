"""Judging, records, rows, pictures and a run that goes on where it was stopped; one real case in full."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from ballfg.benchmarks.diagnosis.cases import (
    QUICK,
    Case,
    Plan,
    Recording,
    all_cases,
    naming_cases,
    planted_case,
    timed_cases,
)
from ballfg.benchmarks.diagnosis.data import planted_free
from ballfg.benchmarks.diagnosis.record import (
    Found,
    Ranked,
    Record,
    alarmed,
    case_digest,
    complete,
    honest,
    named,
    record_of,
    right,
)
from ballfg.benchmarks.diagnosis.rows import ALL, FAILED, HIDDEN, add_all
from ballfg.benchmarks.diagnosis.suite import collect_records, run_loop
from ballfg.benchmarks.results import Results
from tests.diagnosis.made_diagnosis import found, unexplained

SMALL = Plan(
    effects=("wind", "scale", "velocity_lag"),
    unlabelled=("wind",),
    pairs=(("wind", "scale"),),
    sizes=(0.5, 1.0),
    seeds=2,
    side_seeds=2,
    unlabelled_seeds=2,
    nulls=3,
    unknown=("pull",),
    unknown_seeds=2,
    timed=1,
)


def record(
    *findings: tuple[str, ...],
    verdict: str = "effect found",
    invisible: str = "",
    seconds: float = 20.0,
    **errors: float,
) -> Record:
    """Findings are groups: the name, then what it cannot be told from."""
    first = (Ranked(invisible, 0.0, 1.0, None, "cannot be seen in these data"),) if invisible else ()
    return Record(
        digest="",
        verdict=verdict,
        found=tuple(Found(name, tuple(alike), 1e-9, -50.0, {"x": (0.2, 0.01)}) for name, *alike in findings),
        rounds=(first,),
        errors={"before": 20.0, "after": 10.0, **errors},
        patterns={"flight: none": 0.4},
        tracks=50,
        judged=25,
        seconds=seconds,
    )


def test_a_name_is_right_if_it_is_planted_or_in_a_small_group_with_it() -> None:
    assert named(record(("wind",)), ("wind",))
    assert named(record(("gust_region", "wind")), ("wind",))
    assert named(record(("gust_region", "drag", "wind")), ("wind",))
    assert not named(record(("gust_region", "drag", "scale", "wind")), ("wind",))
    assert named(record(("wind", "a", "b", "c", "d")), ("wind",))
    assert not named(record(("scale",), ("wind",)), ("wind",))
    assert not named(record(verdict="nothing lacking"), ("wind",))


def test_what_hides_may_be_in_a_large_group_or_be_called_invisible() -> None:
    lag = ("velocity_lag",)
    assert right(record(("scale", "a", "b", "c", *lag)), lag)
    assert right(record(invisible="velocity_lag"), lag)
    assert not right(record(("scale",), invisible="velocity_lag"), lag)
    assert not right(record(), lag)
    assert not honest(record(invisible="wind"), "velocity_lag")
    assert not right(record(invisible="wind"), ("wind",))  # it does not hide


def test_a_pair_is_complete_if_both_are_found_and_nothing_else() -> None:
    pair = ("wind", "scale")
    assert complete(record(("scale", "drag"), ("gust_region", "wind")), pair)
    assert not complete(record(("scale",)), pair)
    assert not complete(record(("scale",), ("wind",), ("drag",)), pair)


def test_an_alarm_is_a_name_or_another_verdict() -> None:
    even, jittering = Recording(), Recording(jitter=0.0003)
    assert not alarmed(record(verdict="nothing lacking"), even)
    assert alarmed(record(verdict="unexplained"), even)
    assert alarmed(record(("wind",)), jittering)
    assert alarmed(record(("stamp_jitter",)), even)
    assert not alarmed(record(("stamp_jitter",)), jittering)
    assert alarmed(record(("stamp_jitter",), verdict="unexplained"), jittering)


def test_a_record_keeps_what_counts_and_returns_from_its_file(tmp_path: Path) -> None:
    case, path = planted_case("naming", "spin_decay", 1.0, 0), tmp_path / "case.json"
    kept = record_of(case, "of this case", found(), found().before, 12.5)
    assert [f.name for f in kept.found] == ["wind"]
    assert kept.found[0].alike == ("gust_region",)
    assert kept.found[0].parameters["x"] == (0.2, 0.012)
    assert kept.errors["true"] == kept.errors["before"] > kept.errors["after"]
    assert len(kept.rounds[0]) == 8  # the eighth is planted; more would be kept only if they were
    assert kept.rounds[0][0].standing == "added"
    assert (kept.tracks, kept.judged, kept.seconds) == (50, 25, 12.5)
    kept.save(path)
    assert Record.read(path, "of this case") == kept
    assert Record.read(path, "of another") is None
    assert Record.read(tmp_path / "absent.json", "any") is None
    content = json.loads(path.read_text())
    del content["found"][0]["alike"]
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"case.json: must be a finished case .* Delete it"):
        Record.read(path, "of this case")


def test_a_planted_candidate_is_kept_however_weak() -> None:
    kept = record_of(planted_case("naming", "wind_shear", 1.0, 0), "", found(), None, 1.0)
    assert [r.name for r in kept.rounds[0]][-1] == "wind_shear"
    assert kept.rounds[0][-1].standing == "cannot be seen in these data"
    assert "true" not in kept.errors


def test_a_fallback_is_kept() -> None:
    kept = record_of(Case("unknown", "pull", 1.0, 0), "", unexplained(), None, 1.0)
    assert kept.verdict == "unexplained"
    assert kept.errors["fallback"] < kept.errors["named"]


def test_digest_tells_cases_and_measured_files_apart(tmp_path: Path) -> None:
    case = planted_case("naming", "wind", 1.0, 0)
    assert case_digest(case) == case_digest(planted_case("naming", "wind", 1.0, 0))
    assert len({case_digest(replace(case, **{key: value})) for key, value in (("seed", 1), ("repair", True))}) == 2
    assert case_digest(replace(case, recording=Recording(rate=100.0))) != case_digest(case)
    (tmp_path / "tracks.csv").write_text("1")
    measured = Case("measured", "some", 1.0, 0, data=tmp_path)
    before = case_digest(measured)
    (tmp_path / "tracks.csv").write_text("2")
    assert case_digest(measured) != before


def test_the_true_model_is_free_where_something_was_planted() -> None:
    assert set(planted_free(planted_case("naming", "wind", 1.0, 0))) == {f"flight.wind.{a}" for a in "xyz"}
    assert planted_free(planted_case("naming", "gravity", 1.0, 0))["flight.gravity.g"].sigma > 0.1
    gust = planted_free(planted_case("naming", "gust_region", 1.0, 0))
    assert "flight.gust_region.size" in gust  # a shape that is uncertain moves too
    assert not planted_free(planted_case("naming", "spin_label_frame", 1.0, 0))


def outcome(case: Case) -> Record:
    """Wind is always named; scale from its typical size on; what hides is seen not to be there."""
    if case.part == "silence":
        return record(verdict="unexplained" if case.seed == 0 else "nothing lacking")
    if case.part == "unknown":
        return record(verdict="unexplained", named=16.0, fallback=10.0) if case.seed == 0 else record(("wind",))
    if case.subject == "velocity_lag":
        return record(verdict="nothing lacking", invisible="velocity_lag", true=10.0)
    if case.subject == "scale" and case.size < 1.0:
        return record(("wind",))
    return record(*((name,) for name in case.planted), true=8.0)


def test_rows_say_what_was_planned_and_found() -> None:
    cases = [*all_cases(SMALL, 0, []), *timed_cases(SMALL, 0)]
    results = Results("test", 0)
    add_all(results, cases, {case.name: outcome(case) for case in cases})
    labels, typical, half = "naming, spin labels", "1 typical", "0.5 typical"
    assert results.value(labels, typical, "scale") == 1.0
    assert results.value(labels, half, "scale") == 0.0
    assert (results.value(labels, half, ALL), results.value(labels, typical, ALL)) == (0.5, 1.0)
    assert results.value(labels, typical, HIDDEN) == 1.0
    assert results.value("naming, no spin labels", typical, ALL) == 1.0
    assert (results.value("pairs", "first", ALL), results.value("pairs", "both", ALL)) == (1.0, 1.0)
    assert results.value("silence", "effect named", ALL) == 0.0
    assert results.value("silence", "any alarm", ALL) == pytest.approx(1 / 3)
    assert results.value("repair", "after / true", "wind") == pytest.approx(10.0 / 8.0)
    assert results.value("repair", "before / true", "velocity_lag") == 2.0
    assert results.value("unknown physics", "both", "pull") == 0.5
    assert results.value("unknown physics", "error with / without fallback", ALL) == 0.625
    assert results.value("time", "two processes", "one diagnosis, 50 tracks") == 20.0


def test_a_case_without_a_record_is_wrong_and_counted() -> None:
    cases = list(naming_cases(SMALL, 0))
    records = {case.name: outcome(case) for case in cases}
    del records["naming-wind-1-0"]
    results = Results("test", 0)
    add_all(results, cases, records)
    assert results.value("naming, spin labels", "1 typical", "wind") == 0.5
    assert results.value("naming, spin labels", FAILED, ALL) == 1.0


def test_measured_rows_name_what_was_found(tmp_path: Path) -> None:
    (tmp_path / "aimy").mkdir()
    cases = [c for c in all_cases(QUICK, 0, [tmp_path / "aimy"]) if c.part == "measured"]
    assert [case.name for case in cases] == ["measured-aimy-1-0", "measured-aimy-bare-1-0"]
    results = Results("test", 0)
    records = {cases[0].name: record(verdict="unexplained"), cases[1].name: record(("magnus",), ("wind_shear",))}
    add_all(results, cases, records)
    assert results.value("aimy", "bare model", "delta_bic of finding 1, magnus") == -50.0
    assert results.value("aimy", "bare model", "after / before") == 0.5
    assert results.value("aimy", "nominal model", "unexplained") == 1.0


def test_a_run_makes_rows_and_pictures_and_goes_on_where_it_was(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made: list[str] = []

    def run(case: Case) -> Record:
        made.append(case.name)
        if case.name == "silence-nothing-1-1":
            raise ValueError("tracks must be longer")
        return replace(outcome(case), digest=case_digest(case))

    results = Results("test", 0)
    pictures = run_loop(results, [], tmp_path, SMALL, 1, run)
    assert [picture.name for picture in pictures] == ["loop_first_finding.png", "loop_repair.png"]
    assert all(picture.stat().st_size > 10_000 for picture in pictures)
    assert results.value("silence", FAILED, ALL) == 1.0
    said = capsys.readouterr().err
    assert "silence-nothing-1-1: ValueError: tracks must be longer" in said
    assert "note: no --data" in said
    assert made[-1] == "time-wind-1-0"  # alone, after all others
    made.clear()
    again = Results("test", 0)
    run_loop(again, [], tmp_path, SMALL, 1, run)
    assert made == ["silence-nothing-1-1"]  # what failed is tried again, nothing else
    assert again.rows == results.rows


@pytest.mark.thorough
def test_a_real_case_of_a_strong_wind(tmp_path: Path) -> None:
    case = replace(planted_case("naming", "wind", 2.0, 0), recording=Recording(tracks=24, rate=60.0))
    kept = collect_records([case], tmp_path, 1)[case.name]
    assert named(kept, ("wind",))
    assert kept.errors["after"] < kept.errors["before"]
