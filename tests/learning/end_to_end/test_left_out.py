"""Tracks that do not converge, have no gradient or no finite prediction are left out of the loss, and counted."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import pytest
import torch

from ballfg.estimation import Smoother
from ballfg.factors.graph import LevenbergMarquardt
from ballfg.learning.config.training import LossConfig
from ballfg.learning.end_to_end import end_to_end
from ballfg.learning.end_to_end.end_to_end import SOLUTION_TOLERANCE, EndToEnd
from ballfg.learning.end_to_end.learnables import Learnables, NoiseScales
from ballfg.learning.gradient.conjugate_gradients import ConjugateGradients, NotAMinimum
from ballfg.learning.training_data import part
from tests.learning.end_to_end.gradients import gradient
from tests.learning.estimates import NOISE, OBSERVED, SETTINGS, launcher, measured, shots, trainee, usual_ball


def test_tracks_that_do_not_converge_are_left_out() -> None:
    learner = trainee()
    parts = [learner.loss((k,), 0) for k in (0, 2)]
    learner.solver.warm.forget(1)  # the others need hardly an iteration any more
    learner.solver.optimizer = LevenbergMarquardt(tolerance=1e-5, max_iterations=2)
    batch = learner.loss((0, 1, 2), 0)
    assert batch.failed == (("track 1", "the iteration limit was reached"),)
    assert batch.tracks == 2
    assert float(batch.total.detach()) == pytest.approx(sum(float(p.total.detach()) for p in parts), rel=1e-5)
    judged = learner.judge((1,))
    assert (judged.tracks, judged.points, float(judged.total)) == (0, 0, 0.0)
    assert [name for name, _ in judged.failed] == ["track 1"]
    learner.solver.warm.forget(0)
    none = learner.loss((0, 1), 0)
    assert (none.tracks, none.points, float(none.total), none.total.requires_grad) == (0, 0, 0.0, False)


class Choosy(ConjugateGradients):
    """Finds no minimum wherever a track of one sample less than the others is in the batch."""

    def __call__(self, product, right):
        lengths = torch.bincount(self.owners) // 9
        wrong = (lengths == OBSERVED - 1).nonzero()[:, 0].tolist()
        if wrong:
            raise NotAMinimum("no minimum", wrong)
        return super().__call__(product, right)


@pytest.mark.parametrize("wrong", [1, 2])
def test_tracks_without_a_gradient_are_left_out(wrong) -> None:
    """Found in the backward pass; the others' loss and gradient are what they are without it."""
    model, settings = usual_ball(), replace(SETTINGS, launcher=launcher())
    tracks = measured(model, lengths=(36, 30, 40))
    made = shots(tracks, model, settings)
    seen = made[wrong]
    short = replace(seen, observed=OBSERVED - 1, segmentation=shots_of_part(seen, model, settings))
    made[wrong] = short
    learnables = Learnables(model, settings.launcher.embedding, NoiseScales(NOISE, learned=False))
    learner = EndToEnd(made, learnables, LossConfig())
    others = [k for k in range(3) if k != wrong]
    expected, gradients = learner.loss(others, 0), gradient(learner, others)
    learner.linear_solver = partial(Choosy, tolerance=SOLUTION_TOLERANCE)
    found = learner.loss((0, 1, 2), 0)
    assert found.failed == ((f"track {wrong}", "no minimum"),)
    assert (found.tracks, found.points) == (expected.tracks, expected.points)
    assert float(found.total.detach()) == pytest.approx(float(expected.total.detach()), rel=1e-6)
    for name, tensor in gradient(learner).items():
        torch.testing.assert_close(tensor, gradients[name], rtol=1e-4, atol=1e-6)
    assert f"{wrong}.states" not in learner.memory()


def shots_of_part(shot, model, settings):
    """Events of one sample less."""
    return Smoother(model, shot.surfaces, settings).segment(part(shot.track, OBSERVED - 1))


def test_predictions_that_are_not_finite_are_left_out(monkeypatch) -> None:
    learner = trainee()
    expected = learner.loss((0, 2), 0)
    paths = end_to_end.paths

    def spoiled(model, state, times, surfaces):
        found = paths(model, state, times, surfaces)
        bad = (state[:, 4] < -0.5)[:, None, None]  # the second track flies to the right
        return torch.where(bad, torch.nan, found)

    monkeypatch.setattr(end_to_end, "paths", spoiled)
    for found in (learner.loss((0, 1, 2), 0), learner.judge((0, 1, 2))):
        assert found.failed == (("track 1", "the predicted track is not finite"),)
        assert float(found.total.detach()) == pytest.approx(float(expected.total.detach()), rel=1e-5)


def test_a_gradient_that_is_not_a_number_leaves_its_track_out(monkeypatch) -> None:
    """The prediction is finite, its derivative is not: the run goes on with the others."""
    learner = trainee()
    expected = learner.loss((0, 2), 0)
    paths = end_to_end.paths

    def spoiled(model, state, times, surfaces):
        found = paths(model, state, times, surfaces)
        bad = (state[:, 4] < -0.5)[:, None, None]
        return found + 0.0 * torch.sqrt(torch.where(bad, 0.0 * state[:, :1, None].square(), 1.0))  # no slope at zero

    monkeypatch.setattr(end_to_end, "paths", spoiled)
    found = learner.loss((0, 1, 2), 0)
    assert [name for name, _ in found.failed] == ["track 1"]
    assert float(found.total.detach()) == pytest.approx(float(expected.total.detach()), rel=1e-5)
    assert all(bool(g.isfinite().all()) for g in gradient(learner, (0, 2)).values())
