"""Real processes that record and are killed: the quick version of `python -m tests.live.killed_recordings`."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.live.killed_recordings import Case, run


@pytest.mark.thorough  # a quicker one: test_recording.py
@pytest.mark.parametrize("case", [Case("jsonl", "tcp", 1.7), Case("mcap", "pipe", 2.2)], ids=["jsonl", "mcap"])
def test_a_kill_loses_nothing_and_the_same_command_continues(case: Case, tmp_path: Path) -> None:
    if case.ending == "mcap":
        pytest.importorskip("rosbags", reason="the extra 'ros' is not installed")
    found = run(case, tmp_path)
    assert found.sent > 30
    assert (found.missing, found.lost) == (0, 0)
    assert found.added > 0 or case.ending == "mcap"
    assert [path.name for path in tmp_path.iterdir()] == [f"states.{case.ending}"]
