"""A case from simulation to record, the diagnosis made by hand; the true model in earnest."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from ballfg.benchmarks.diagnosis.cases import Recording, planted_case
from ballfg.benchmarks.diagnosis.suite import run_case
from tests.diagnosis.made_diagnosis import silent


@pytest.mark.parametrize("name", ["magnus", "spin_label_frame"])
def test_a_case_is_simulated_diagnosed_and_compared_with_the_truth(name: str) -> None:
    asked = SimpleNamespace()

    def diagnose(dataset: object, model: object, *, jobs: int) -> object:
        asked.tracks, asked.model, asked.jobs = len(dataset), model, jobs  # type: ignore[arg-type]
        return silent()

    case = replace(planted_case("naming", name, 1.0, 0), recording=Recording(tracks=6, rate=60.0), repair=True)
    kept = run_case(case, diagnose)
    assert (asked.tracks, asked.jobs) == (6, 1)
    assert ("magnus" in asked.model.flight) == (name != "magnus")
    assert 5.0 < kept.errors["true"] < 20.0  # mm, with half a second to predict
    assert not kept.found
