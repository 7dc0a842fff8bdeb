"""A command is ended at random moments; `python -m tests.faults.signals` does it to all, hundreds of times."""

import pytest

from tests.faults.signals import trials


@pytest.mark.parametrize("moments", [2, pytest.param(6, marks=pytest.mark.thorough)])
def test_a_signal_at_a_random_moment_leaves_nothing(moments: int) -> None:
    tally = trials(moments, 4, ["import"])
    assert tally.wrong == []
    assert tally.counts["moments"] == moments
