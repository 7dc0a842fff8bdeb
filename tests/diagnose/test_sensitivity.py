"""Derivatives by forward mode against central differences of the predictions, for every effect."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ballfg.diagnose import sensitivity as module
from ballfg.diagnose.sensitivity import predict, sensitivity
from ballfg.dynamics import EFFECTS
from ballfg.dynamics.paths import paths

STATE_STEPS = np.array([1e-5] * 3 + [1e-4] * 3 + [1e-2] * 3)
SHIFTED = {"time_offset": {"x": 0.001, "y": -0.002, "z": 0.003}, "magnus_saturation": {"strength": 0.2}}
"""Away from kinks: of the three offsets one is the smallest."""
SPECIAL = {"scale": 1e-4, "spin_label_offset": 1e-2}


@pytest.fixture(scope="module")
def stretches(make_ball, make_launches, make_shots):
    """Three shots, with a contact each or two."""
    return make_shots(make_ball(), make_launches(3, 3), 3, rate=40.0).stretches


def values_of(name, listed, point):
    """Coefficients of an effect at its absent values, or a little away from them."""
    values = {c.name: c.default if c.absent is None or point == "present" else c.absent for c in listed}
    if point == "present":
        values = {c.name: values[c.name] + 0.1 * c.sigma * (i + 1) for i, c in enumerate(listed)}
        values |= SHIFTED.get(name, {})
    return values


def differences(model, stretches, values, name, step):
    """By one coefficient: O(step^2), 1e-8 and less of the column, beside rounding of 1e-13 / step."""
    starts = stretches.starts.numpy()
    up, down = (predict(model, stretches, starts, values | {name: values[name] + s}) for s in (step, -step))
    return (up.positions - down.positions) / (2 * step), (up.labels - down.labels) / (2 * step)


@pytest.mark.parametrize("point", ["absent", "present"])
@pytest.mark.parametrize("name", [n for n in EFFECTS if n != "gravity"])
def test_every_effect(make_ball, stretches, name, point):
    effect = EFFECTS[name]
    own = values_of(name, effect.coefficients, point)
    model = make_ball(**{name: own})
    section = {"flight": "flight", "bounce": "contact", "measurement": "measurement"}[effect.kind]
    values = {f"{section}.{name}.{c}": v for c, v in own.items()}
    steps = [1e-3 * (c.sigma or 1.0) for c in effect.coefficients]
    found = sensitivity(model, stretches, stretches.starts.numpy(), values, tuple(values), by_start=False)
    assert found.positions.shape == (3, stretches.times.shape[1], 3, len(values))
    if (name, point) == ("time_offset", "absent"):
        return  # a kink: see below
    for i, (column, step) in enumerate(zip(values, steps, strict=True)):
        positions, labels = differences(model, stretches, values, column, step)
        scale = max(np.abs(positions).max(), 1e-3 / (effect.coefficients[i].sigma or 1.0))
        np.testing.assert_allclose(found.positions[..., i], positions, rtol=0, atol=2e-6 * scale)
        np.testing.assert_allclose(found.labels[..., i], labels, rtol=0, atol=2e-6 * max(1.0, np.abs(labels).max()))


def test_equal_time_offsets_differ_from_central_differences_by_a_shift_of_the_clock(make_ball, stretches, surfaces):
    """At the kink the smallest of three is shared out in thirds; central differences see it half of the time."""
    model = make_ball(time_offset={})
    values = {f"measurement.time_offset.{a}": 0.0 for a in "xyz"}
    starts = stretches.starts.numpy()
    found = sensitivity(model, stretches, starts, values, tuple(values), by_start=False).positions
    states = paths(make_ball(), stretches.starts, stretches.times[0], surfaces)
    for i, column in enumerate(values):
        central, _ = differences(model, stretches, values, column, 1e-7)
        np.testing.assert_allclose(found[..., i] - central, states[..., 3:6].numpy() / 6, rtol=0, atol=1e-5)


def test_gravity_of_a_declared_model(make_ball, stretches):
    model, values = make_ball(), {"flight.gravity.g": 9.81}
    found = sensitivity(model, stretches, stretches.starts.numpy(), values, tuple(values), by_start=False)
    positions, _ = differences(model, stretches, values, "flight.gravity.g", 1e-3)
    np.testing.assert_allclose(found.positions[..., 0], positions, rtol=0, atol=1e-7)


def test_by_start_through_contacts(make_ball, stretches):
    model = make_ball(spin_label_offset={"x": 5.0}, velocity_lag={"lag": 0.002}, time_scale={"s": 0.01})
    starts, values = stretches.starts.numpy(), {"flight.drag.k": 0.1}
    found = sensitivity(model, stretches, starts, values, ())
    for i, step in enumerate(STATE_STEPS):
        move = step * np.eye(9)[i]
        up, down = (predict(model, stretches, starts + s * move, values) for s in (1, -1))
        central = (up.positions - down.positions) / (2 * step)
        np.testing.assert_allclose(found.positions[..., i], central, rtol=0, atol=2e-6 * max(1e-2, np.abs(central).max()))
        np.testing.assert_allclose(found.labels[..., i], np.tile(np.eye(9)[i, 6:], (3, 1)), rtol=0, atol=1e-12)


def test_prediction_is_the_motion_as_measured(make_ball, stretches, surfaces):
    model = make_ball(scale={"x": 0.01}, spin_label_scale={"s": 0.1})
    found = predict(model, stretches, stretches.starts.numpy(), {"flight.drag.k": 0.09})
    exact = paths(make_ball(drag={"k": 0.09}), stretches.starts, stretches.times[0], surfaces)[..., :3].numpy()
    np.testing.assert_allclose(found.positions, exact * (1.01, 1.0, 1.0), rtol=0, atol=2e-9)
    np.testing.assert_allclose(found.labels, 1.1 * stretches.starts[:, 6:].numpy(), rtol=1e-15)
    assert np.array_equal(np.isnan(found.contacts), stretches.heights.isnan().numpy())


def test_directions_in_parts_are_the_same(make_ball, stretches, monkeypatch):
    values = {"flight.drag.k": 0.1, "contact.restitution.e": 0.9}
    starts = stretches.starts.numpy()
    whole = sensitivity(make_ball(), stretches, starts, values, tuple(values))
    monkeypatch.setattr(module, "MOST_ROWS", 12)
    parts = sensitivity(make_ball(), stretches, starts, values, tuple(values))
    np.testing.assert_allclose(parts.positions, whole.positions, rtol=0, atol=1e-9)
    assert np.array_equal(parts.labels, whole.labels)


def test_padding_has_no_part(make_ball, stretches):
    """A longer stretch beside one pads it; what is predicted for it stays."""
    model, starts = make_ball(), stretches.starts.numpy()
    alone = stretches.take([1])
    assert len(alone) == 1 and alone.names == ("001",)
    one, all_ = (predict(model, s, s.starts.numpy(), {}) for s in (alone, stretches))
    np.testing.assert_allclose(one.positions[0], all_.positions[1], rtol=0, atol=2e-9)
    assert starts.shape == (3, 9)
    assert torch.equal(alone.heights[0].isnan(), stretches.heights[1].isnan())
