"""Two commands are ended at random moments; `python -m tests.faults.signals` does it to all, hundreds of times."""

from __future__ import annotations

import pytest

from tests.faults.signals import trials


@pytest.mark.parametrize("name", ["import", "train-2"])
def test_a_signal_at_a_random_moment_leaves_nothing(name: str) -> None:
    tally = trials(3, 4, [name])
    assert tally.wrong == []
    assert tally.counts["moments"] == 3
