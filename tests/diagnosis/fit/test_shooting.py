"""Smooth shooting against the rollout that finds its own contacts."""

from __future__ import annotations

import pytest
import torch

from ballfg.diagnosis.fit.shooting import shoot
from ballfg.dynamics import rollout
from ballfg.dynamics.model import substitute
from ballfg.dynamics.motion.paths import paths

pytestmark = pytest.mark.usefixtures("no_graph")
END = 1.08
INTEGRATION = 1e-6
"""m. Arcs are cut into longer steps: errors of 6e-8 m a step, that grow through three contacts."""


@pytest.fixture
def no_graph():
    with torch.no_grad():
        yield


@pytest.fixture(scope="module")
def model(make_ball):
    return make_ball(
        spin_decay={"rate": 0.3},
        wind={"x": 0.4, "y": -0.2, "z": 0.1},
        drag_spin={"gain": 0.3},
        tangential_restitution={"e_t": 0.2},
        restitution_speed={"slope": 0.02},
        table_height={"offset": -0.004},
        table_tilt={"x": 0.01, "y": -0.02},
    )


@pytest.fixture(scope="module")
def states(make_launches):
    """Six shots that bounce once to three times."""
    states = make_launches(6, 5)
    states[:, 2] += torch.linspace(-0.1, 0.3, 6, dtype=torch.float64)
    return states


@pytest.fixture(scope="module")
def stretches(make_shots, model, states):
    return make_shots(model, states, duration=END).stretches


def shot(model, states, stretches, guesses):
    return shoot(model, states, stretches.heights, guesses, torch.full_like(stretches.ends, END))


def test_the_shots_bounce_differently_often(stretches):
    assert sorted(set((~stretches.heights.isnan()).sum(1).tolist())) >= [1, 2]


@pytest.mark.parametrize("late", [0.0, 0.012, -0.012], ids=["near", "guessed late", "guessed early"])
def test_states_are_those_of_paths(model, states, stretches, surfaces, late):
    times = torch.linspace(0.0, END, 90, dtype=torch.float64)
    motion = shot(model, states, stretches, stretches.contacts + late)
    moved = motion.states(times.unsqueeze(1).expand(-1, len(states))).transpose(0, 1)
    exact = paths(model, states, times, surfaces)
    torch.testing.assert_close(moved[..., :3], exact[..., :3], rtol=0, atol=INTEGRATION)
    torch.testing.assert_close(moved, exact, rtol=0, atol=3e-5)


def test_states_are_those_of_the_rollout(model, states, stretches, surfaces):
    times = torch.tensor((0.2, 0.55, 1.0), dtype=torch.float64)
    motion = shot(model, states, stretches, stretches.contacts)
    moved = motion.states(times.unsqueeze(1).expand(-1, len(states))).transpose(0, 1)
    exact = rollout(model, states, times, surfaces)
    torch.testing.assert_close(moved[..., :3], exact[..., :3], rtol=0, atol=INTEGRATION)


def test_at_a_contact_the_ball_touches_and_turns(model, states, stretches):
    motion = shot(model, states, stretches, stretches.contacts)
    assert torch.equal(motion.contacts.isnan(), stretches.heights.isnan())
    first = motion.contacts[:, :1].T
    before, after = motion.states(first - 1e-9)[0], motion.states(first)[0]
    assert float(model.gap(after, stretches.heights[:, 0]).abs().max()) < 1e-9
    assert bool((model.gap_rate(before) < -0.5).all())
    torch.testing.assert_close(after[:, 3:], model.after_bounce(before)[:, 3:], rtol=0, atol=1e-6)


def test_each_row_has_its_own_coefficients(model, states, stretches):
    drags = torch.linspace(0.08, 0.16, len(states), dtype=torch.float64).unsqueeze(1)
    together = shot(substitute(model, {"flight.drag.k": drags}), states, stretches, stretches.contacts)
    times = torch.full((1, len(states)), 0.9, dtype=torch.float64)
    for i, k in enumerate(drags[:, 0]):
        alone = shot(substitute(model, {"flight.drag.k": k}), states, stretches, stretches.contacts)
        torch.testing.assert_close(together.states(times)[0, i], alone.states(times)[0, i], rtol=0, atol=1e-6)


def test_a_ball_that_never_comes_down_is_nan_from_there_on_and_alone(model, states, stretches):
    sunk = states.clone()
    sunk[2, 2], sunk[2, 5] = 0.3, 0.5  # under the table: it never reaches its surface from above
    motion = shot(model, sunk, stretches, stretches.contacts)
    moved = motion.states(torch.tensor((0.05, 1.05), dtype=torch.float64).unsqueeze(1).expand(-1, len(states)))
    assert bool(moved[0].isfinite().all())
    assert moved[1].isnan().any(-1).tolist() == [i == 2 for i in range(len(states))]
    assert bool(motion.contacts[2].isnan().all())


def test_a_row_that_was_never_known_to_come_down_is_nan_and_alone(model, states, stretches):
    """It has no time to shoot for: the motion about which it was linearised had missed its surface."""
    unknown = stretches.contacts.clone()
    unknown[2] = torch.nan
    asked = torch.tensor((0.05, 1.05), dtype=torch.float64).unsqueeze(1).expand(-1, len(states))
    found, whole = (shot(model, states, stretches, times).states(asked) for times in (unknown, stretches.contacts))
    assert bool(found[1, 2].isnan().all())
    others = [i for i in range(len(states)) if i != 2]
    torch.testing.assert_close(found[:, others], whole[:, others], rtol=0, atol=1e-6)
