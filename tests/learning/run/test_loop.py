from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import pytest
import torch

from ballfg.learning.config.training import OptimizerConfig, TrainConfig
from ballfg.learning.run.loop import Task, Training, TrainingStoppedError, rate_factor
from ballfg.learning.run.ranks import Ranks
from ballfg.learning.run.run_folder import Checkpoint, Epoch
from tests.learning.run.falling_ball import NOISE, TRUE_DRAG, TRUE_GRAVITY, FallingBalls


def pass_on(items: Iterable[list[int]], _total: int, _what: str) -> Iterator[list[int]]:
    return iter(items)


TRAIN, VALIDATION = tuple(range(10)), (10, 11, 12)


def task(
    *words: str, train: tuple[int, ...] = TRAIN, validation: tuple[int, ...] = VALIDATION, seed: int = 3, **fields: Any
) -> Task:
    optimizer = OptimizerConfig(**({"learning_rate": 0.05, "batch": 4, "epochs": 4, "clip": None} | fields))
    config = TrainConfig(seed=seed, data=words or ("plain",), optimizer=optimizer)
    return Task(FallingBalls(words, seed), train, validation, config, Ranks(), pass_on)


def finished(training: Training) -> list[Epoch]:
    return list(training.epochs())


def same_bits(a: Checkpoint, b: Checkpoint) -> None:
    assert a.progress == b.progress
    for name in ("weights", "best", "optimizer", "memory"):
        x, y = getattr(a, name), getattr(b, name)
        assert x.keys() == y.keys()
        assert all(torch.equal(x[key], y[key]) for key in x), name


def test_it_learns_what_made_the_tracks() -> None:
    training = Training(task(epochs=150, learning_rate=0.5, batch=10))
    epochs = finished(training)
    training.take_best()
    found = training.module.state_dict()
    # 1 mm noise leaves 0.1 % of uncertainty; the rest is what the optimizer has still to go
    assert float(found["drag"]) == pytest.approx(TRUE_DRAG, rel=0.01)
    assert float(found["gravity"]) == pytest.approx(TRUE_GRAVITY, rel=0.002)
    assert epochs[0].validation_rmse > 0.05  # before the first step
    assert epochs[-1].validation_rmse == pytest.approx(math.sqrt(2.0) * NOISE, rel=0.15)
    assert [epoch.epoch for epoch in epochs] == list(range(151))


def test_a_step_is_that_of_the_mean_gradient_of_its_batch() -> None:
    # one batch of all tracks, one epoch: AdamW's first step is the rate times the sign of each gradient
    run = task(batch=10, epochs=1, learning_rate=1e-3, schedule="constant", weight_decay=0.5)
    alone = FallingBalls((), 3)
    alone.judge(range(13))  # what the loop does first
    alone.loss(range(10), 0).total.backward()
    before = {name: value.detach().clone() for name, value in run.trainee.module.named_parameters()}
    epochs = finished(Training(run))
    for name, scale in (("drag", 1.0), ("gravity", 2.0)):
        rate = scale * 1e-3
        sign = getattr(alone.module, name).grad.sign()
        expected = before[name] * (1.0 - 0.5 * rate) - rate * sign
        if name == "drag":
            expected = expected.clamp(min=0.0)
        torch.testing.assert_close(getattr(run.trainee.module, name).detach(), expected, rtol=0.0, atol=1e-10)
    gradients = torch.cat([p.grad.reshape(-1) for p in alone.module.parameters()]) / 10
    assert epochs[1].gradient_norm == pytest.approx(float(gradients.norm()), rel=1e-6)


def test_the_gradient_is_clipped_to_its_norm() -> None:
    # Adam does not see the length of its first gradient, but remembers it
    training = Training(task(batch=10, epochs=1, clip=0.25))
    finished(training)
    first = training.checkpoint().optimizer
    mean = torch.cat([first[f"{name}/exp_avg"].reshape(-1) for name in ("drag", "gravity")])
    assert float(mean.norm()) == pytest.approx(0.25 * (1.0 - 0.9), rel=1e-6)


def test_a_resumed_run_is_the_uninterrupted_one_bit_for_bit() -> None:
    whole = Training(task(batch=3, epochs=4))
    finished(whole)
    begun = Training(task(batch=3, epochs=4))
    epochs = begun.epochs()
    for _ in range(3):  # 0, 1, 2
        next(epochs)
    resumed = Training(task(batch=3, epochs=4), begun.checkpoint())
    assert [epoch.epoch for epoch in finished(resumed)] == [3, 4]
    same_bits(resumed.checkpoint(), whole.checkpoint())
    # and it is not for want of memory or chance: without them the numbers differ
    bare = begun.checkpoint()
    forgetful = Training(task(batch=3, epochs=4), Checkpoint(bare.progress, bare.weights, bare.best, bare.optimizer))
    finished(forgetful)
    assert not torch.equal(forgetful.module.drag, whole.module.drag)
    other = Training(task(batch=3, epochs=4, seed=4))
    finished(other)
    assert not torch.equal(other.module.drag, whole.module.drag)


def test_the_best_weights_are_kept_beside_the_last() -> None:
    swinging: dict[str, Any] = {"batch": 10, "learning_rate": 0.6, "schedule": "constant"}
    training = Training(task(epochs=7, **swinging))
    errors = [epoch.validation_rmse for epoch in finished(training)]
    best = int(np.argmin(errors))
    assert 0 < best < 7
    kept = training.checkpoint()
    assert (kept.progress.best_epoch, kept.progress.best_rmse) == (best, errors[best])
    until_then = Training(task(epochs=best, **swinging))
    finished(until_then)
    training.take_best()
    assert torch.equal(training.module.drag, until_then.module.drag)
    assert not torch.equal(kept.weights["drag"], until_then.module.drag)


def test_without_validation_the_last_weights_are_the_best() -> None:
    training = Training(task(validation=()))
    assert {epoch.validation_rmse for epoch in finished(training)} == {None}
    assert training.checkpoint().progress.best_rmse is None
    assert torch.equal(training.best["drag"], training.module.drag)


def test_failed_tracks_are_left_out_and_told() -> None:
    epochs = finished(Training(task("failing-4", batch=10)))
    assert [epoch.failed for epoch in epochs] == [0, 1, 1, 1, 1]
    others = finished(Training(task(batch=10, train=(0, 1, 2, 3, 5, 6, 7, 8, 9))))
    for epoch, other in zip(epochs[1:], others[1:], strict=True):
        assert epoch.loss == pytest.approx(other.loss, rel=1e-9)
        assert epoch.validation_rmse == pytest.approx(other.validation_rmse, rel=1e-9)
    alone = finished(Training(task("failing-4", batch=1)))  # a step without any track
    assert alone[1].failed == 1


def test_too_many_failed_tracks_stop_it() -> None:
    training = Training(task("failing-1", "failing-4", "failing-7"))
    with pytest.raises(
        TrainingStoppedError, match=r"more than 20 % of the 10 training tracks failed .* 'ball-\d'"
    ) as e:
        finished(training)
    assert "it was not seen. Raise failure_limit to go on without them." in str(e.value)


def test_steps_that_are_not_finite_are_skipped_and_then_stop_it() -> None:
    training = Training(task("infinite", batch=4, epochs=20))  # three steps an epoch; not finite from the second on
    epochs = training.epochs()
    assert [next(epochs).skipped, next(epochs).skipped] == [0, 0]
    kept = training.module.drag.detach().clone()
    second = next(epochs)
    assert (second.skipped, second.loss) == (3, None)
    assert torch.equal(training.module.drag, kept)
    assert training.checkpoint().progress.skipped_in_row == 3
    with pytest.raises(
        TrainingStoppedError, match=r"not finite in 11 steps in a row. Set optimizer.learning_rate lower"
    ):
        list(epochs)
    assert torch.equal(training.module.drag, kept)


def test_another_run_is_not_continued() -> None:
    training = Training(task(epochs=1))
    with pytest.raises(ValueError, match="must follow an epoch; got none yet"):
        training.checkpoint()
    finished(training)
    with pytest.raises(ValueError, match=r"it has 10 to train and 3 to validate, the data 10 and 1. Give the same"):
        Training(task(validation=(10,)), training.checkpoint())
    there = training.checkpoint()
    for weights, optimizer in (
        ({"drag": there.weights["drag"]}, {}),
        (there.weights, {"other/step": torch.tensor(1.0)}),
    ):
        with pytest.raises(ValueError, match="must be of the same model"):
            Training(task(), Checkpoint(there.progress, weights, there.best, optimizer))


def test_a_group_with_a_parameter_of_no_name_is_refused() -> None:
    run = task()
    stray = torch.nn.Parameter(torch.zeros(()))
    run.trainee.groups = lambda: [{"name": "stray", "params": [stray], "scale": 1.0}]  # type: ignore[method-assign]
    with pytest.raises(ValueError, match="group 'stray' must hold parameters of the module"):
        Training(run)


def test_the_learning_rate_is_a_function_of_the_step() -> None:
    settings = OptimizerConfig(epochs=4, warm_start_epochs=1)
    factors = [rate_factor(settings, step, 10) for step in range(40)]
    np.testing.assert_allclose(factors[:10], np.arange(1, 11) / 10)
    np.testing.assert_allclose(factors[10:], 0.5 + 0.5 * np.cos(np.pi * np.arange(30) / 30), atol=1e-15)
    constant = OptimizerConfig(epochs=4, schedule="constant")
    assert {rate_factor(constant, step, 10) for step in range(40)} == {1.0}
    assert rate_factor(OptimizerConfig(epochs=1, warm_start_epochs=2), 9, 10) == 0.5
