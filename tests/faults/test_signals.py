"""A command is ended at random moments; `python -m tests.faults.signals` does it to all, hundreds of times."""

import pytest

from tests.faults.signals import trials


@pytest.mark.thorough  # quicker ones: tests/test_interrupts.py, test_kills.py, tests/cli/test_live.py
def test_a_signal_at_a_random_moment_leaves_nothing() -> None:
    tally = trials(4, 4, ["import"])
    assert tally.wrong == []
    assert tally.counts["moments"] == 4
