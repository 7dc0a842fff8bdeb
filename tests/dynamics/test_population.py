"""Spins of groups of shots: their mixture, their place in a model file, and what is refused there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ballfg.dynamics import load_model, nominal_model, save_model
from ballfg.dynamics.model_file import model_from_dict, model_to_dict
from ballfg.dynamics.population import SpinGroup, SpinPopulation, launch_axes

BACK = SpinGroup((0.0, -150.0, 5.0), (8.0, 20.0, 6.0), 10)
TOP = SpinGroup((-12.0, 140.0, -10.0), (9.0, 30.0, 7.0), 30)
SPINS = SpinPopulation("group", {"back": BACK, "top": TOP})


def test_a_known_group_has_its_own_mean_and_spread() -> None:
    mean, covariance = SPINS.spin("back")
    np.testing.assert_array_equal(mean, BACK.mean)
    np.testing.assert_allclose(covariance, np.diag(np.square(BACK.sigma)))


def test_a_number_names_the_group_of_earlier_files_and_unknown_ones_are_counted() -> None:
    numbered = SpinPopulation("session", {"1.0": BACK, "2": TOP})
    for group, mean in (("1", BACK.mean), ("2.0", TOP.mean)):
        numbered.check(group)
        np.testing.assert_array_equal(numbered.spin(group)[0], mean)
    assert numbered.unknown([{"session": 1.0}, {"session": "2.0"}, {}]) == ()
    (note,) = numbered.unknown([{"session": 1.0}, {"session": 3.0}, {"session": "b"}, {}])
    assert note.startswith("2 of 3 tracks are of groups (session) that the model does not know, such as '3': ")


def test_an_unseen_group_counts_as_one_of_those_seen() -> None:
    """Laplace's rule: of k groups of equal weight and one that nobody has seen, the next one is new once in k + 1."""
    generator, count = np.random.default_rng(5), 600_000
    draws = np.concatenate(
        [generator.normal(TOP.mean, TOP.sigma, (count, 3)), generator.normal(0.0, 60.0, (count, 3))],
    )
    mean, covariance = SpinPopulation("group", {"top": TOP}).with_unseen(60.0).spin("side")
    np.testing.assert_allclose(mean, draws.mean(axis=0), atol=0.5)
    np.testing.assert_allclose(covariance, np.cov(draws.T), rtol=0.01, atol=10.0)
    np.testing.assert_array_equal(SPINS.with_unseen(60.0).spin("top")[0], TOP.mean)
    (note,) = SPINS.unknown([{"group": "side"}])
    assert note.endswith("they get the mixture of its groups, back, top, and of the usual prior")


@pytest.mark.parametrize("unknown", [None, "side"])
def test_an_unknown_group_has_the_moments_of_the_mixture(unknown: str | None) -> None:
    generator, count = np.random.default_rng(4), 400_000
    draws = np.concatenate(
        [generator.normal(group.mean, group.sigma, (count * group.tracks // 40, 3)) for group in (BACK, TOP)]
    )
    mean, covariance = SPINS.spin(unknown)
    np.testing.assert_allclose(mean, draws.mean(axis=0), atol=0.7)
    np.testing.assert_allclose(covariance, np.cov(draws.T), rtol=0.01, atol=5.0)


def test_launch_axes_turn_with_the_launch() -> None:
    forward, across, up = launch_axes(np.array([-3.0, 4.0, 2.0]))
    np.testing.assert_allclose(forward, [-0.6, 0.8, 0.0])
    np.testing.assert_allclose(across, np.cross(up, forward))
    np.testing.assert_array_equal(up, [0.0, 0.0, 1.0])
    np.testing.assert_array_equal(launch_axes(np.array([0.0, 0.0, 5.0])), np.eye(3))


def test_a_model_file_keeps_the_groups(tmp_path: Path) -> None:
    model = nominal_model()
    model.spins = SPINS
    save_model(model, tmp_path / "model.yaml")
    assert load_model(tmp_path / "model.yaml").spins == SPINS


def test_a_model_without_groups_has_the_file_that_it_had() -> None:
    content = model_to_dict(nominal_model())
    assert "populations" not in content
    assert model_from_dict(content).spins is None


GROUP = {"mean": [0.0, 1.0, 2.0], "sigma": [1.0, 1.0, 1.0], "tracks": 3}


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"drag": {}}, "populations' must be a mapping with 'spin'"),
        ({"spin": {"by": "group"}}, "with 'by' and 'groups'"),
        ({"spin": {"by": "group", "groups": {}}}, "at least one group"),
        ({"spin": {"by": "group", "groups": {"a": {"mean": [1.0]}}}}, r"groups\.a must be a mapping"),
        ({"spin": {"by": "group", "groups": {"a": {**GROUP, "mean": [1.0]}}}}, r"groups\.a\.mean must be three"),
        ({"spin": {"by": "group", "groups": {"a": {**GROUP, "sigma": [1.0, 0.0, 1.0]}}}}, "sigma"),
        ({"spin": {"by": "group", "groups": {"a": {**GROUP, "mean": [1.0, "x", 1.0]}}}}, "mean"),
        ({"spin": {"by": "group", "groups": {"a": {**GROUP, "tracks": 0}}}}, "at least 1"),
    ],
)
def test_a_bad_section_is_refused(section: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        model_from_dict({**model_to_dict(nominal_model()), "populations": section})
