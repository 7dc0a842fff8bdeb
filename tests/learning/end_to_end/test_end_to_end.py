"""Learning end to end: its gradient against differences, sums over shards, places in the room, tracks that fail."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from ballfg.dynamics import Surfaces, rollout
from ballfg.learning.augment import augmentation
from ballfg.learning.config.training import LossConfig
from ballfg.learning.end_to_end import solving
from ballfg.learning.end_to_end.end_to_end import COEFFICIENT_STEP, LOSS_UNIT, EndToEnd
from ballfg.learning.end_to_end.learnables import Learnables, NoiseScales
from ballfg.learning.end_to_end.solving import Pose
from ballfg.learning.gradient.conjugate_gradients import ConjugateGradients
from ballfg.learning.gradient.implicit import GaussNewtonGradient, ImplicitGradient
from ballfg.learning.training_data import TrainingShot
from tests.learning.end_to_end.gradients import gradient, network
from tests.learning.estimates import (
    NOISE,
    OBSERVED,
    SETTINGS,
    TIGHT,
    directional,
    launcher,
    measured,
    shots,
    trainee,
    usual_ball,
)


def check(learner: EndToEnd, steps: dict[str, float], tolerance: float) -> None:
    """Of the loss against differences of what `judge` says at parameters nearby, all estimates solved anew."""
    found, parameters = gradient(learner), dict(learner.module.named_parameters())
    for name, step in steps.items():
        leaf = parameters[name]
        direction = torch.randn(leaf.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        expected = directional(lambda: learner.judge((0, 1, 2)).total, [leaf], [direction], step)
        got = float((found[name] * direction).sum())
        print(f"{name} {got:.6g} {got / expected - 1.0:.0e}")  # shown by -s
        assert got == pytest.approx(expected, rel=tolerance), name


pytestmark = pytest.mark.usefixtures("networks_in_torch")
STEPS = {
    "model.flight.drag.k": 5e-4,
    "model.bounce.restitution.e": 5e-4,
    "model.bounce.table_height.offset": 2e-6,
    "embedding.weight": 5e-4,
    "noise.process": 5e-4,
    "noise.position": 2e-4,
    "noise.spin": 5e-4,
}
EXACT = partial(ConjugateGradients, tolerance=1e-12)


def test_gradient_is_that_of_the_loss() -> None:
    """Through rollout and estimate together; 1e-7 is seen when both are solved tightly."""
    check(trainee(LossConfig(position_scale=0.01), linear_solver=EXACT), STEPS, 2e-6)


def test_gradient_as_it_is_used() -> None:
    """With the tolerances of a training, against those of the tight solution."""
    loose = gradient(trainee(optimizer=solving.TRAINING))
    tight = gradient(trainee(linear_solver=EXACT))
    errors = {name: float((loose[name] - tight[name]).norm() / tight[name].norm()) for name in tight}
    print({name: f"{error:.0e}" for name, error in errors.items()})  # shown by -s
    assert max(errors.values()) < 1e-3


def test_the_value_of_the_loss() -> None:
    """By `rollout` from the smoothed first states: per track the mean over its usable samples, in centimetres."""
    learner = trainee(noise=False)
    loss, judged = learner.loss((0, 1, 2), 0), learner.judge((0, 1, 2))
    solved, _ = learner.solver((0, 1, 2), {})
    total = squared = 0.0
    for one in solved:
        track = learner.shots[one.number].track
        with torch.no_grad():
            states = torch.from_numpy(one.solution.minimum.values.states[:1])
            times = torch.from_numpy(track.times - track.times[0])
            path = rollout(learner.learnables.model, states, times, learner.shots[one.number].surfaces)[
                0, :, :3
            ].numpy()
        errors = np.square(path - track.positions).sum(axis=1)
        total += 0.5 * errors.mean() / LOSS_UNIT**2
        squared += errors.sum()
    for batch in (loss, judged):
        assert float(batch.total.detach()) == pytest.approx(total, rel=1e-6)
        assert batch.squared_error == pytest.approx(squared, rel=1e-6)
        assert (batch.tracks, batch.points, batch.failed) == (3, sum(len(s.track) for s in learner.shots), ())
    assert not judged.total.requires_grad


def test_unusable_samples_and_the_horizon() -> None:
    """Neither counts: not in the error, not in the number of points."""
    learner = trainee(LossConfig(horizon=0.1), noise=False)
    usable = learner.shots[0].usable.copy()
    usable[[3, OBSERVED + 2]] = False
    spoiled = learner.shots[0].track.positions.copy()
    spoiled[[OBSERVED + 2, -1]] = 1e3
    learner.shots[0] = replace(
        learner.shots[0], usable=usable, track=replace(learner.shots[0].track, positions=spoiled)
    )
    batch = learner.loss((0, 1, 2), 0)
    points = 0
    for shot in learner.shots:
        times = shot.track.times
        points += int((shot.usable & (times <= times[shot.observed - 1] + 0.1)).sum())
    assert batch.points == points < sum(len(s.track) for s in learner.shots)
    assert float(batch.total.detach()) < 1e3
    growing = trainee(LossConfig(horizon_start=0.05, horizon_epochs=4), noise=False)
    counted = [growing.loss((0, 1, 2), epoch).points for epoch in (0, 2, 4, 9)]
    assert counted[0] < counted[1] < counted[2] == counted[3] == growing.judge((0, 1, 2)).points
    half = 0  # after two of four epochs: half way from the first horizon to what is left after the observed samples
    for shot in growing.shots:
        times, since = shot.track.times, float(shot.track.times[shot.observed - 1])
        half += int((times <= since + (0.05 + float(times[-1]) - since) / 2 + 1e-9).sum())
    assert counted[1] == half


def test_the_shot_shown_has_the_error_that_is_judged() -> None:
    learner = trainee()
    judged, shot = learner.judge((1,)), learner.shown(1)
    assert shot is not None
    assert shot.name == learner.shots[1].name
    assert len(shot.times) == judged.points
    assert ((shot.predicted - shot.measured) ** 2).sum() == pytest.approx(judged.squared_error, rel=1e-9)
    observed = learner.shots[1].observed
    assert (shot.times > 0.0).sum() == learner.shots[1].usable[observed:].sum()
    before = {one.name: one for one in learner.learned()}
    assert before["position noise"].before == before["position noise"].after
    with torch.no_grad():
        learner.learnables.noise.position += np.log(2.0)
    after = {one.name: one for one in learner.learned()}
    assert after["position noise"].after == pytest.approx(2.0 * after["position noise"].before)
    assert set(before) >= {"position noise", "spin noise", "acceleration"}


def test_a_far_point_pulls_linearly() -> None:
    """`position_scale`: the loss of each point is Huber's of its distance."""
    plain, robust = trainee(noise=False), trainee(LossConfig(position_scale=0.004), noise=False)
    squares, robusts = plain.judge((0, 1, 2)), robust.judge((0, 1, 2))
    assert robusts.squared_error == pytest.approx(squares.squared_error, rel=1e-9)
    solved, _ = robust.solver((0, 1, 2), {})
    with torch.no_grad():
        first = torch.stack([torch.from_numpy(s.solution.minimum.values.states[0]) for s in solved])
        prediction = robust.predict(solved, first, None)
    distance = prediction.error.norm(dim=-1)
    far = distance > 0.004
    assert 0 < int(far.sum()) < prediction.counts.sum()
    huber = torch.where(far, 0.004 * (distance - 0.002), 0.5 * distance**2) / LOSS_UNIT**2
    expected = (huber.sum(1) / prediction.counts.sum(1)).sum()
    assert float(robusts.total) == pytest.approx(float(expected), rel=1e-9)


def test_likelihood_is_added() -> None:
    """And only the noise sees its gradient."""
    alone, both = trainee(), trainee(LossConfig(likelihood=0.3))
    one, two = alone.loss((0, 1, 2), 0), both.loss((0, 1, 2), 0)
    assert float(two.total.detach() - one.total.detach()) != 0.0
    without, among = gradient(alone), gradient(both)
    for name, expected in without.items():
        if name.startswith("noise."):
            assert not torch.allclose(among[name], expected, rtol=1e-3)
        else:
            torch.testing.assert_close(among[name], expected, rtol=1e-6, atol=1e-9)


def test_shards_add_up() -> None:
    """Nothing but rounding, and what is left of a linear solution, depends on the batch: neither value nor gradient."""
    whole, parts = trainee(), trainee()
    total, pieces = whole.loss((0, 1, 2), 0), [parts.loss(part, 0) for part in ((2, 0), (1,))]
    assert sum(float(p.total.detach()) for p in pieces) == pytest.approx(float(total.total.detach()), rel=1e-9)
    assert sum(p.squared_error for p in pieces) == pytest.approx(total.squared_error, rel=1e-9)
    assert [sum(p.tracks for p in pieces), sum(p.points for p in pieces)] == [total.tracks, total.points]
    together = gradient(whole)
    apart = [gradient(parts, part) for part in ((2, 0), (1,))]
    for name, expected in together.items():
        summed = sum(g[name] for g in apart if name in g)
        torch.testing.assert_close(
            summed, expected, rtol=1e-4, atol=1e-4 * float(expected.abs().max())
        )  # solved to 1e-5


def test_surfaces_of_different_heights_in_one_batch() -> None:
    """Two datasets, each with its table: a batch of both is each by itself, whatever settings they share.

    The second shot's only contact lies in its last interval, where the estimate finds it, given the right table.
    """
    model, settings = usual_ball(), replace(SETTINGS, launcher=launcher())
    tracks = measured(model, lengths=(36, 30, 40))
    lifted = [replace(t, positions=t.positions + np.array([0.0, 0.0, 0.5])) for t in tracks[1:2]]
    both = [*shots(tracks[:1], model, settings), *shots(lifted, model, settings, Surfaces(0.5))]
    (contact,) = both[1].segmentation.contacts
    events = replace(both[1].segmentation, contacts=(), quality=np.zeros(contact.interval + 2, dtype=np.int8))
    both[1] = replace(both[1], settings=both[0].settings, observed=contact.interval + 2, segmentation=events)
    learnables = Learnables(model, settings.launcher.embedding, NoiseScales(NOISE, learned=False))
    together, _ = EndToEnd(both, learnables, LossConfig(), optimizer=TIGHT).solver((0, 1), {})
    for k in (0, 1):
        (alone,), _ = EndToEnd(both, learnables, LossConfig(), optimizer=TIGHT).solver((k,), {})
        assert len(alone.solution.events.contacts) == len(together[k].solution.events.contacts) == 1
        states = alone.solution.minimum.values.states
        np.testing.assert_allclose(together[k].solution.minimum.values.states, states, rtol=1e-6, atol=1e-6)
    losses = [EndToEnd(both, learnables, LossConfig(), optimizer=TIGHT).judge(part) for part in ((0, 1), (0,), (1,))]
    assert float(losses[0].total) == pytest.approx(float(losses[1].total + losses[2].total), rel=1e-6)


# --- where the shots are seen from


@pytest.mark.parametrize("labels", ["launcher", "spin"])
def test_a_symmetric_model_does_not_care_where_it_is(labels) -> None:
    """Turned about z and shifted, through segmentation, estimate and rollout: the same loss, the same predictions."""
    learner = trainee(model=network(), noise=False)
    number = 0 if labels == "launcher" else 1
    assert (learner.shots[number].track.spin_label is None) == (labels == "launcher")
    pose = Pose(*augmentation(1, 2, 3))
    (plain,), _ = learner.solver((number,), {})
    learner.solver.warm.forget(number)
    (turned,), _ = learner.solver((number,), {number: pose})
    expected = pose.states(plain.solution.minimum.values.states)
    scale = np.repeat((1.0, 1.0, 100.0), 3)
    assert np.abs((turned.solution.minimum.values.states - expected) / scale).max() < 1e-9
    with torch.no_grad():
        errors = []
        for one in (plain, turned):
            first = torch.from_numpy(one.solution.minimum.values.states[:1])
            errors.append(learner.predict([one], first, None).error[0].norm(dim=-1))
    torch.testing.assert_close(errors[1], errors[0], rtol=0, atol=1e-9)


def test_predictions_turn_with_the_data() -> None:
    """The data itself turned, events found anew: predicted tracks turn with it.

    The segmentation gives the times of contacts to 1e-6 s when the data turns; they enter the process noise in parts of
    an interval.
    """
    model, settings = network(), replace(SETTINGS, launcher=launcher())
    tracks = measured(usual_ball(), lengths=(36, 30, 40))
    pose = Pose(torch.tensor(2.1, dtype=torch.float64), torch.tensor([0.3, -0.7], dtype=torch.float64))
    plain, turned = (shots(seen, usual_ball(), settings) for seen in (tracks, [pose.track(t) for t in tracks]))
    for one, other in zip(plain, turned, strict=True):
        assert [c.interval for c in one.segmentation.contacts] == [c.interval for c in other.segmentation.contacts]
        np.testing.assert_array_equal(one.usable, other.usable)
    learnables = Learnables(model, settings.launcher.embedding, NoiseScales(NOISE, learned=False))
    expected = predictions(plain, learnables)
    for found, known in zip(predictions(turned, learnables), expected, strict=True):
        np.testing.assert_allclose(found, pose.positions(known), rtol=0, atol=1e-9)


def predictions(made: list[TrainingShot], learnables: Learnables) -> list[np.ndarray]:
    """(n, 3) m for each shot."""
    learner = EndToEnd(made, learnables, LossConfig(), optimizer=TIGHT)
    solved, failed = learner.solver(range(len(made)), {})
    assert not failed
    with torch.no_grad():
        first = torch.stack([torch.from_numpy(s.solution.minimum.values.states[0]) for s in solved])
        error = learner.predict(solved, first, None).error
    return [error[k, : len(s.positions)].numpy() + s.positions for k, s in enumerate(solved)]


def test_augmentation_is_drawn_for_each_track_and_epoch() -> None:
    """The loss of the usual ball stays, too; warm starts are kept as they are measured."""
    plain, turned = trainee(noise=False), trainee(noise=False, augment=True, seed=4)
    expected = plain.loss((0, 1, 2), 0)
    for epoch in (0, 1):
        found = turned.loss((0, 1, 2), epoch)
        assert float(found.total.detach()) == pytest.approx(float(expected.total.detach()), rel=1e-5)
    for name, tensor in plain.memory().items():
        torch.testing.assert_close(turned.memory()[name], tensor, rtol=1e-4, atol=1e-4)


# --- warm starts


def test_memory_makes_the_next_loss_the_same_to_the_bit() -> None:
    first, second = trainee(), trainee()
    first.loss((0, 1, 2), 0)
    remembered = {name: tensor.clone() for name, tensor in first.memory().items()}
    assert len(remembered) == 9
    with torch.no_grad():
        for learner in (first, second):
            learner.learnables.model.flight.drag.k += 0.01
    second.remember(remembered)
    expected, found = first.loss((0, 1, 2), 1), second.loss((0, 1, 2), 1)
    assert float(found.total.detach()) == float(expected.total.detach())
    for name, tensor in gradient(first).items():
        assert torch.equal(tensor, gradient(second)[name]), name
    for name, tensor in first.memory().items():
        assert torch.equal(tensor, second.memory()[name]), name


# --- what an optimizer sees


def test_groups_and_bounds() -> None:
    learner = trainee()
    model = learner.learnables.model
    groups = {g["name"]: (g["scale"], len(g["params"])) for g in learner.groups()}
    coefficients = {
        f"model.{name}": (COEFFICIENT_STEP * c.sigma, 1) for name, c in model.declared_coefficients().items()
    }
    assert len(coefficients) == 8
    assert groups == {"noise.": (10.0, 3), "embedding.": (3.0, 1)} | coefficients
    with torch.no_grad():
        model.bounce.restitution.e.fill_(5.0)
        learner.learnables.noise.spin.fill_(99.0)
    learner.after_step()
    high = model.declared_coefficients()["bounce.restitution.e"].high
    assert float(model.bounce.restitution.e.detach()) == high
    assert float(learner.learnables.noise.spin.detach()) == 12.0
    assert {g["name"] for g in trainee(noise=False).groups()} == {"embedding.", *coefficients}
    corrected = {name.replace("model.", "model.base.") for name in coefficients}
    assert {g["name"] for g in trainee(model=network(), noise=False).groups()} == {"embedding.", "model.", *corrected}


def test_the_method_is_the_caller_s() -> None:
    exact, default = gradient(trainee(noise=False, method=ImplicitGradient())), gradient(trainee(noise=False))
    near = gradient(trainee(noise=False, method=GaussNewtonGradient()))
    for name, tensor in exact.items():
        assert torch.equal(tensor, default[name])
    drag = "model.flight.drag.k"
    assert 1e-4 < abs(float(near[drag] / exact[drag]) - 1.0) < 0.5
