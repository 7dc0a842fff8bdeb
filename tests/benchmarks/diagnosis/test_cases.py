"""What is planted, and the datasets made of it."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ballfg.benchmarks.diagnosis.cases import (
    BARE,
    FULL,
    PAIRS,
    PLANTS,
    QUICK,
    UNKNOWN,
    Case,
    Recording,
    measured_cases,
    naming_cases,
    null_cases,
    null_recording,
    planted_case,
    timed_cases,
    unknown_cases,
)
from ballfg.benchmarks.diagnosis.data import actual_model, declared_model, make_dataset
from ballfg.dynamics import EFFECTS, AnalyticModel, nominal_model
from ballfg.simulation import SimulationConfig, parse_effects
from tests.places import ROOT

STATES = torch.tensor(
    [[1.2, 0.3, 0.9, 3.0, 0.4, -2.0, 30.0, 120.0, -60.0], [2.0, -0.2, 1.1, 5.0, -0.3, 1.0, -20.0, -90.0, 40.0]],
    dtype=torch.float64,
)


def doings(model: AnalyticModel) -> torch.Tensor:
    """Everything that a model says about some states: motion, contact, surface, measurement."""
    with torch.no_grad():
        acceleration, spin_rate = model.rates(STATES)
        falling = STATES.clone()
        falling[:, 5] = -2.0  # the first grips the table, the second slides
        offset = torch.as_tensor(model.surface_offset(STATES), dtype=torch.float64).expand(2).unsqueeze(-1)
        parts = [
            acceleration,
            torch.zeros_like(acceleration) if spin_rate is None else spin_rate,
            model.after_bounce(falling),
            offset,
            model.measured(STATES, lambda delay: STATES + 0.01 * delay.reshape(-1, 1)),
            model.true_stamps(torch.tensor([[0.3], [0.7]], dtype=torch.float64)),
            model.labelled(STATES[:, 6:]),
        ]
        return torch.cat(parts, dim=-1)


def test_every_effect_of_the_catalogue_is_planted() -> None:
    assert set(PLANTS) == set(EFFECTS) - {"counted_frames"}  # a simulation drops no counted frames
    assert {name for pair in PAIRS for name in pair} <= set(PLANTS)


def test_the_page_names_the_hidden_effects() -> None:
    text = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    (told,) = re.findall(r"\. ([^.]*) are hidden: others do the same", text)
    assert set(re.findall(r"`(\w+)`", told)) == {plant.name for plant in PLANTS.values() if plant.hidden}


@pytest.mark.parametrize("name", PLANTS)
def test_size_zero_is_the_declared_model_and_size_one_is_not(name: str) -> None:
    plant = PLANTS[name]
    one = planted_case("naming", name, 1.0, 0)
    declared = doings(declared_model(one, 0.02))
    if plant.sized:
        none = planted_case("naming", name, 0.0, 0)
        torch.testing.assert_close(doings(actual_model(none)), declared, rtol=0.0, atol=1e-15)
    assert not torch.allclose(doings(actual_model(one)), declared, rtol=1e-5)


@pytest.mark.parametrize("name", PLANTS)
def test_hypothesis_is_the_planted_effect(name: str) -> None:
    plant = PLANTS[name]
    hypothesis = plant.hypothesis()
    assert hypothesis.name == name
    (effect,) = parse_effects(plant.texts(1.0))
    reached = {c: plant.base + dict(plant.amounts).get(c, 0.0) for c in hypothesis.strengths}
    for coefficient in effect.coefficients:
        value = float(getattr(effect, coefficient.name).detach())
        expected = hypothesis.shape.get(coefficient.name, reached.get(coefficient.name))
        assert value == pytest.approx(expected)


def test_gravity_is_planted_beside_the_declared_one() -> None:
    case = planted_case("naming", "gravity", 1.0, 0)
    assert float(actual_model(case).flight["gravity"].g) == pytest.approx(9.91)
    assert float(declared_model(case, 0.02).flight["gravity"].g) == 9.81


def test_a_left_out_effect_takes_along_those_that_need_it() -> None:
    bare = declared_model(Case("measured", "x", 1.0, 0, left_out=BARE), 0.02)
    assert set(bare.flight) == {"gravity", "drag"}
    assert set(bare.bounce) == {"restitution", "friction"}
    assert set(nominal_model().flight) == {"gravity", "drag", "magnus"}


def test_cases_have_names_and_random_streams_of_their_own() -> None:
    cases = [
        *naming_cases(FULL, 0),
        *null_cases(FULL, 0),
        *unknown_cases(FULL, 0),
        *timed_cases(FULL, 0),
        *measured_cases([Path("data/aimy"), Path("data/spindoe")]),
    ]
    assert len({case.name for case in cases}) == len(cases)
    assert len({case.stream for case in cases}) == len(cases)
    named = [case for case in cases if case.part == "naming"]
    assert len(named) == FULL.seeds * len(PLANTS) + FULL.side_seeds * 2 * (
        len(PLANTS) - 1
    )  # the label frame has one size
    assert not any("spin_label" in case.subject for case in cases if case.part == "no_labels")
    assert all(case.recording.labels is (case.part != "no_labels") for case in cases if case.part != "silence")


def test_quick_plan_is_small() -> None:
    cases = list(naming_cases(QUICK, 3))
    assert len([case for case in cases if case.part == "naming"]) == 8
    assert {(case.size, case.seed) for case in cases} == {(1.0, 3)}
    assert len(list(null_cases(QUICK, 0))) == 5


def test_null_recordings_cover_what_they_should_and_can_be_simulated() -> None:
    taken = [null_recording(seed) for seed in range(100)]
    assert {r.tracks for r in taken} <= set(range(12, 61))
    assert min(r.position for r in taken) < 0.0012 < 0.005 < max(r.position for r in taken) <= 0.006
    assert sum(abs(r.position / 0.003 - 1.0) > 0.3 for r in taken) > 50
    assert {r.rate for r in taken} == {60.0, 100.0, 120.0, 180.0, 240.0}
    assert 30 < sum(r.labels for r in taken) < 70
    assert 30 < sum(bool(r.levels) for r in taken) < 70
    for r in taken:
        assert SimulationConfig(rate=r.rate, settings=dict(r.levels)).combinations().shape[0] in (8, 693)
        assert r.jitter * r.rate <= 0.15


def test_datasets_state_the_same_noise_whatever_it_is(tmp_path: Path) -> None:
    case = replace(planted_case("naming", "wind", 1.0, 0), recording=Recording(tracks=2, position=0.0, spin=0.0))
    exact = make_dataset(case, tmp_path / "exact")
    noisy = make_dataset(replace(case, recording=Recording(tracks=2, position=0.006, labels=False)), tmp_path / "noisy")
    assert exact.info.position_noise == noisy.info.position_noise == 0.003
    assert (exact.info.spin_noise, noisy.info.spin_noise) == (4.0, None)
    apart = np.concatenate([a.positions - b.positions for a, b in zip(exact, noisy, strict=True)])
    assert apart.std() == pytest.approx(0.006, rel=0.1)
    assert all(track.spin_label is None for track in noisy)


def test_two_sessions_follow_one_another_on_different_tables(tmp_path: Path) -> None:
    sessions = UNKNOWN["two_tables"]
    case = Case("unknown", "two_tables", 1.0, 0, sessions=sessions, recording=Recording(tracks=6, position=0.0))
    names = make_dataset(case, tmp_path / "tracks").names
    assert names == ["0-000", "0-001", "0-002", "1-000", "1-001", "1-002"]


def test_datasets_of_one_folder_name_are_refused() -> None:
    with pytest.raises(ValueError, match="datasets must differ in the names of their folders; got 'aimy' twice"):
        list(measured_cases([Path("a/aimy"), Path("b/aimy")]))


def test_a_pair_is_planted_with_both_effects_at_their_typical_size() -> None:
    pairs = [case for case in naming_cases(FULL, 0) if case.part == "pairs"]
    assert {case.planted for case in pairs} == set(PAIRS)
    for case in pairs:
        (texts,) = case.sessions
        for name in case.planted:
            assert set(planted_case("naming", name, 1.0, 0).sessions[0]) <= set(texts)
