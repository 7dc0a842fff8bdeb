"""The two ends of `make mutants`: what one run of the suite tells of lines, and a change that is tried in a copy."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.mutants.__main__ import Killed, Verdict, unreached
from tests.mutants.mutations import Mutation, mutations_of
from tests.mutants.reach import Recording, record, recorded_tests
from tests.mutants.trial import Workshop
from tests.places import ROOT

FILE = "ballfg/files/whole_folder.py"
TEST = "tests/files/test_whole_folder.py::test_an_earlier_result_is_replaced_and_other_files_stay"


@pytest.fixture(scope="module")
def change() -> Mutation:
    """The new folder does not take the place of the old one."""
    return next(
        m for m in mutations_of(FILE, (ROOT / FILE).read_bytes()) if m.before == "exchange(place / NEW, target)"
    )


@pytest.mark.thorough
def test_a_run_tells_which_test_reaches_a_line(tmp_path: Path, change: Mutation) -> None:
    record(tmp_path, ["tests/files/test_whole_folder.py"], 1)
    assert recorded_tests(tmp_path) == ["tests/files/test_whole_folder.py"]
    recording = Recording(tmp_path)
    assert recording.failed == []
    reaching = recording.reaching(FILE, change.line, change.line)
    assert TEST in reaching
    assert 0 < len(reaching) < len(recording.seconds)
    assert all(seconds > 0.0 for seconds in reaching.values())
    assert recording.reaching("ballfg/estimation/filters/ekf.py", 100, 100) == {}
    lines, text = recording.unreached(FILE), (ROOT / FILE).read_text(encoding="utf-8").splitlines()
    assert change.line not in lines
    told = unreached(recording, ["files"]).splitlines()
    assert {f"{FILE}:{line} {text[line - 1].strip()}" for line in lines} <= set(told)
    assert all(line.startswith("ballfg/files/") for line in told[:-1])
    assert any(line.endswith("# macOS") for line in told)
    assert told[-1] == f"{len(told) - 1} statements that no test reaches"


def test_a_change_is_noticed_in_a_copy_and_taken_back(tmp_path: Path, change: Mutation) -> None:
    source, stamp = (ROOT / FILE).read_bytes(), os.stat(ROOT / FILE).st_mtime_ns
    with Workshop(tmp_path / "machine_code") as workshop:
        outcome = workshop.attempt(change, [TEST], 1.0, compile_anew=False)
        assert (workshop.tree / FILE).read_bytes() == source
        assert os.stat(workshop.tree / FILE).st_mtime_ns == stamp
        assert workshop.failing([TEST], 1.0, compile_anew=False) == []
    assert (outcome.killed, outcome.by) == (True, TEST)
    assert not workshop.folder.exists()
    assert (ROOT / FILE).read_bytes() == source


@pytest.mark.thorough
def test_tests_that_are_not_there_notice_nothing(tmp_path: Path, change: Mutation) -> None:
    """As after a test was renamed: pytest ends with an error, with the change and without it."""
    with (
        Workshop(tmp_path / "machine_code") as workshop,
        pytest.raises(RuntimeError, match=r"must run the recorded tests; got .*Record anew"),
    ):
        workshop.attempt(change, [f"{TEST}_and_yet_not"], 1.0, compile_anew=False)


def test_what_was_noticed_is_kept_for_a_file_as_it_is(tmp_path: Path, change: Mutation) -> None:
    killed = Killed(tmp_path / "killed.jsonl", begin=True)
    killed.add(Verdict(change, "killed", TEST, 1.0))
    assert Killed(tmp_path / "killed.jsonl", begin=False).by == {Killed.key(change): TEST}
    assert Killed(tmp_path / "killed.jsonl", begin=True).by == {}
