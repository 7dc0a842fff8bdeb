"""Derivatives by forward mode against central differences of the predictions, for every effect."""

from __future__ import annotations

import numpy as np
import pytest

from ballfg.diagnosis.fit.sensitivity import predict, sensitivity
from ballfg.dynamics import EFFECTS
from ballfg.dynamics.motion.paths import paths

STATE_STEPS = np.array([1e-5] * 3 + [1e-4] * 3 + [1e-2] * 3)
SHIFTED = {"time_offset": {"x": 0.001, "y": -0.002, "z": 0.003}, "magnus_saturation": {"strength": 0.2}}
"""Away from kinks: of the three offsets one is the smallest."""
SHARE = 1e-3
"""Steps are this share of a coefficient's prior: truncation and rounding are both some 1e-8 of a column."""


@pytest.fixture(scope="module")
def stretches(make_ball, make_launches, make_shots):
    """Three shots, with one contact or two, none of them within 1 ms of a sample."""
    return make_shots(make_ball(), make_launches(3, 3), 3, rate=41.0).stretches


def parameters(name, own):
    return {f"{EFFECTS[name].kind}.{name}.{c}": v for c, v in own.items()}


def differences(model, stretches, values, step):
    """Central, along a step of several coefficients."""
    starts = stretches.starts.numpy()
    up, down = (
        predict(model, stretches, starts, {n: v + sign * step.get(n, 0.0) for n, v in values.items()})
        for sign in (1, -1)
    )
    return (up.positions - down.positions) / 2, (up.labels - down.labels) / 2


def assert_same(found, wanted, least=0.0):
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-5 * max(least, np.abs(wanted).max()))


@pytest.mark.parametrize("name", [n for n in EFFECTS if n not in ("gravity", "time_offset")])
def test_an_absent_effect(make_ball, stretches, name):
    """What the score test looks at, one coefficient after the other."""
    listed = {c.name: c for c in EFFECTS[name].coefficients if c.absent is not None}
    model, values = make_ball(**{name: {n: c.absent for n, c in listed.items()}}), {}
    values = parameters(name, {n: c.absent for n, c in listed.items()})
    found = sensitivity(model, stretches, stretches.starts.numpy(), values, tuple(values), by_start=False)
    assert found.positions.shape == (3, stretches.times.shape[1], 3, len(values))
    for i, (column, c) in enumerate(zip(values, listed.values(), strict=True)):
        step = SHARE * c.sigma
        positions, labels = differences(model, stretches, values, {column: step})
        assert_same(step * found.positions[..., i], positions, 1e-7)
        assert_same(step * found.labels[..., i], labels, 1e-7)


@pytest.mark.parametrize("name", [n for n in EFFECTS if n != "gravity"])
def test_a_present_effect(make_ball, stretches, name):
    """Along one direction that changes all of its coefficients."""
    listed = {c.name: c for c in EFFECTS[name].coefficients}
    own = {n: c.default + 0.1 * c.sigma * (i + 1) for i, (n, c) in enumerate(listed.items())} | SHIFTED.get(name, {})
    model, values = make_ball(**{name: own}), parameters(name, own)
    step = {n: SHARE * c.sigma * (-1) ** i for i, (n, c) in enumerate(zip(values, listed.values(), strict=True))}
    found = sensitivity(model, stretches, stretches.starts.numpy(), values, tuple(values), by_start=False)
    positions, labels = differences(model, stretches, values, step)
    assert_same(found.positions @ np.array(list(step.values())), positions, 1e-7)
    assert_same(found.labels @ np.array(list(step.values())), labels, 1e-7)


MEASURING = [name for name, effect in EFFECTS.items() if effect.kind == "measurement"]


@pytest.mark.parametrize("rows", [[0, 1, 2], [1]], ids=["three", "alone"])
@pytest.mark.parametrize("chosen", [*([name] for name in MEASURING), MEASURING], ids=lambda chosen: "+".join(chosen))
def test_the_chain_rule_gives_what_dual_numbers_give(make_ball, stretches, chosen, rows):
    """By first states and all coefficients, alone and with the instrument's errors one upon another."""
    own = {
        name: {c.name: c.default + 0.1 * c.sigma * (i + 1) for i, c in enumerate(EFFECTS[name].coefficients)}
        | SHIFTED.get(name, {})
        for name in chosen
    }
    model, values = make_ball(**own), {"flight.drag.k": 0.1}
    for name in chosen:
        values |= parameters(name, own[name])
    part, names = stretches.take(rows), tuple(values)
    chained = sensitivity(model, part, part.starts.numpy(), values, names)
    dual = sensitivity(model, part, part.starts.numpy(), values, names, shapes=[{}] * len(names))
    for found, wanted in ((chained.positions, dual.positions), (chained.labels, dual.labels)):
        largest = np.abs(wanted).reshape(-1, wanted.shape[-1]).max(axis=0)
        assert (np.abs(found - wanted) <= 1e-7 * largest + 1e-12).all()


def test_the_chain_rule_shares_a_kink_out_as_dual_numbers_do(make_ball, stretches):
    """Of three equal offsets each is the smallest."""
    values = {f"measurement.time_offset.{a}": 0.0 for a in "xyz"}
    model, starts = make_ball(time_offset={}), stretches.starts.numpy()
    chained = sensitivity(model, stretches, starts, values, tuple(values)).positions
    dual = sensitivity(model, stretches, starts, values, tuple(values), shapes=[{}] * 3).positions
    np.testing.assert_allclose(chained, dual, rtol=0, atol=1e-7 * np.abs(dual).max())


def test_equal_time_offsets_differ_from_central_differences_by_a_shift_of_the_clock(make_ball, stretches, surfaces):
    """At the kink the smallest of three is shared out in thirds; central differences see it half of the time."""
    model = make_ball(time_offset={})
    values = {f"measurement.time_offset.{a}": 0.0 for a in "xyz"}
    starts = stretches.starts.numpy()
    found = sensitivity(model, stretches, starts, values, tuple(values), by_start=False).positions
    states = paths(make_ball(), stretches.starts, stretches.times[0], surfaces)
    for i, column in enumerate(values):
        central = differences(model, stretches, values, {column: 1e-6})[0] / 1e-6
        np.testing.assert_allclose(found[..., i] - central, states[..., 3:6].numpy() / 6, rtol=0, atol=1e-5)


def test_gravity_of_a_declared_model(make_ball, stretches):
    model, values = make_ball(), {"flight.gravity.g": 9.81}
    found = sensitivity(model, stretches, stretches.starts.numpy(), values, tuple(values), by_start=False)
    positions, _ = differences(model, stretches, values, {"flight.gravity.g": 1e-3})
    assert_same(1e-3 * found.positions[..., 0], positions)


def test_by_start_through_contacts(make_ball, stretches):
    model = make_ball(spin_label_offset={"x": 5.0}, velocity_lag={"lag": 0.002}, time_scale={"s": 0.01})
    starts, values = stretches.starts.numpy(), {"flight.drag.k": 0.1}
    found = sensitivity(model, stretches, starts, values, ())
    for i, step in enumerate(STATE_STEPS):
        move = step * np.eye(9)[i]
        up, down = (predict(model, stretches, starts + s * move, values) for s in (1, -1))
        central = (up.positions - down.positions) / (2 * step)
        np.testing.assert_allclose(
            found.positions[..., i], central, rtol=0, atol=2e-6 * max(1e-2, np.abs(central).max())
        )
        np.testing.assert_allclose(found.labels[..., i], np.tile(np.eye(9)[i, 6:], (3, 1)), rtol=0, atol=1e-12)


def test_prediction_is_the_motion_as_measured(make_ball, stretches, surfaces):
    model = make_ball(scale={"x": 0.01}, spin_label_scale={"s": 0.1})
    found = predict(model, stretches, stretches.starts.numpy(), {"flight.drag.k": 0.09})
    exact = paths(make_ball(drag={"k": 0.09}), stretches.starts, stretches.times[0], surfaces)[..., :3].numpy()
    np.testing.assert_allclose(found.positions, exact * (1.01, 1.0, 1.0), rtol=0, atol=1e-6)  # steps differ
    np.testing.assert_allclose(found.labels, 1.1 * stretches.starts[:, 6:].numpy(), rtol=1e-15)
    assert np.array_equal(np.isnan(found.contacts), stretches.heights.isnan().numpy())


def test_directions_in_parts_are_the_same(make_ball, stretches):
    values = {"flight.drag.k": 0.1, "bounce.restitution.e": 0.9}
    starts = stretches.starts.numpy()
    whole = sensitivity(make_ball(), stretches, starts, values, tuple(values))
    parts = sensitivity(make_ball(), stretches, starts, values, tuple(values), most_rows=12)
    np.testing.assert_allclose(parts.positions, whole.positions, rtol=0, atol=1e-9)
    assert np.array_equal(parts.labels, whole.labels)


def test_a_stretch_alone_is_predicted_as_beside_others(make_ball, stretches):
    """The longest stretch lays out the steps: the error of the integration differs."""
    model, alone = make_ball(), stretches.take([1])
    assert (len(alone), alone.names) == (1, ("001",))
    one, every = (predict(model, s, s.starts.numpy(), {}) for s in (alone, stretches))
    np.testing.assert_allclose(one.positions[0], every.positions[1], rtol=0, atol=1e-6)
    found, among = (sensitivity(model, s, s.starts.numpy(), {}, ()) for s in (alone, stretches))
    assert_same(found.positions[0], among.positions[1])
