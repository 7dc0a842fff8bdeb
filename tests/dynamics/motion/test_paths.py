"""Paths are rollouts: states and gradients, through bounces, rest, the table's edge, whatever the times.

Both take steps of at most 20 ms, cut at other places: the integrations differ by their own error, some 1e-8 m in flight
at 6 m/s and some 1e-6 m after strongly spinning bounces. Where Runge-Kutta is exact (no air) they agree to rounding.
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from ballfg.dynamics import Surfaces, rollout
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.model import substitute
from ballfg.dynamics.motion.integrate import fly
from ballfg.dynamics.motion.paths import paths

UNIT = torch.tensor([1.0] * 3 + [1.0] * 3 + [100.0] * 3, dtype=torch.float64)
TIMES = torch.arange(0, 91, dtype=torch.float64) / 100


def apart(model, state: Tensor, times: Tensor, surfaces: Surfaces) -> Tensor:
    """(n, k) largest difference in m, m/s, 100 rad/s."""
    with torch.no_grad():
        found, expected = paths(model, state, times, surfaces), rollout(model, state, times, surfaces)
    assert found.shape == expected.shape
    assert bool(found.isfinite().all())
    return ((found - expected)[..., :9] / UNIT).abs().amax(-1)


def test_paths_are_rollouts(any_model, states, table) -> None:
    worst = apart(any_model, states(12), TIMES, table)
    print(float(worst.max()))  # shown by -s
    assert float(worst[:, TIMES < 0.2].max()) < 2e-6
    assert float(worst.max()) < 2e-5


def test_without_air_they_agree_to_rounding(build, states) -> None:
    """Many bounces, of balls that bounce at other times: the events alone are compared."""
    model = build(gravity={}, restitution={"e": 0.7}, friction={"mu": 0.25}, tangential_restitution={"e_t": 0.1})
    state = states(10)
    assert float(apart(model, state, TIMES, Surfaces(0.0)).max()) < 1e-11


def test_bounces_are_there(model, states, table) -> None:
    """Velocities jump between neighbouring stamps: the comparison above is not one of free flight."""
    with torch.no_grad():
        found = paths(model, states(12), TIMES, table)
    jumps = (found[:, 1:, 5] - found[:, :-1, 5]) > 1.0
    assert int(jumps.sum(1).min()) >= 1
    assert int(jumps.sum(1).max()) >= 3


def test_between_steps_flight_is_as_good_as_at_their_ends(model, states) -> None:
    """The polynomial: against flights that end at each of the times, to the integration's own error."""
    state = states(8)
    times = torch.linspace(0.0, 0.05, 23, dtype=torch.float64)
    with torch.no_grad():
        found = paths(model, state, times, Surfaces(-50.0))
        for k, t in enumerate(times):
            one = fly(model, state, t.expand(8))
            assert float(((found[:, k] - one) / UNIT).abs().max()) < 5e-7
    torch.testing.assert_close(found[:, 0], state, rtol=0, atol=0)


def test_each_row_has_its_own_times(model, states, table) -> None:
    """(n, k) times, equal ones at the end as padding: each row as by itself, whatever flies beside it."""
    state = states(3)
    rows = [torch.linspace(0.05, end, k, dtype=torch.float64) for end, k in ((0.8, 9), (0.3, 4), (1.2, 9))]
    padded = torch.stack([torch.cat((t, t[-1].expand(9 - len(t)))) for t in rows])
    with torch.no_grad():
        together = paths(model, state, padded, table)
        for k, times in enumerate(rows):
            alone = paths(model, state[k : k + 1], times, table)[0]
            torch.testing.assert_close(together[k, : len(times)], alone, rtol=1e-10, atol=1e-10)
            after = alone[-1].expand(9 - len(times), 9)
            torch.testing.assert_close(together[k, len(times) :], after, rtol=1e-10, atol=1e-10)
    assert float(apart(model, state, padded, table).max()) < 2e-5


def gradients(function, model, state: Tensor, times: Tensor, surfaces: Surfaces) -> list[Tensor]:
    leaf = state.clone().requires_grad_(True)
    found = function(model, leaf, times, surfaces)
    weights = torch.randn(found.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64) / found.shape[1]
    wanted = [leaf, *model.parameters()]
    return list(torch.autograd.grad((weights * found / UNIT).sum(), wanted, allow_unused=True))


def test_gradients_are_those_of_the_rollout(any_model, states, table) -> None:
    """By the first states and by every parameter, through the contact times."""
    state, times = states(5), TIMES[::6]
    found = gradients(paths, any_model, state, times, table)
    expected = gradients(rollout, any_model, state, times, table)
    for a, b in zip(found, expected, strict=True):
        assert (a is None) == (b is None)
        if b is not None:
            print(f"{float((a - b).abs().max() / b.abs().max()):.0e}")  # shown by -s
            torch.testing.assert_close(a, b, rtol=0, atol=1e-4 * float(b.abs().max()))


def test_gradients_are_those_of_differences(model, states, table) -> None:
    """Directional, by the states: 1e-6, wherever a stamp does not fall on a contact."""
    state, times = states(5), TIMES[5::17]
    leaf = state.clone().requires_grad_(True)
    (found,) = torch.autograd.grad((paths(model, leaf, times, table) / UNIT).sum(), leaf)
    direction = UNIT * torch.randn(state.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    with torch.no_grad():
        at = {k: float((paths(model, state + k * 1e-5 * direction, times, table) / UNIT).sum()) for k in (-2, -1, 1, 2)}
    expected = (8 * (at[1] - at[-1]) - (at[2] - at[-2])) / 12e-5
    assert float((found * direction).sum()) == pytest.approx(expected, rel=1e-6)


def test_rest_and_what_starts_strangely(model, table) -> None:
    """At rest from the start, into rest, below the surface on the way down or up, lost below it, beside the table."""
    state = torch.zeros(7, 9, dtype=torch.float64)
    surface = 0.02 + float(model.surface_offset(state[0]).detach())
    state[:, 2], state[:, 3] = surface, 1.0
    state[1, 2], state[1, 5] = surface + 0.004, -0.1  # a few tiny hops, then rest
    state[2, 2], state[2, 5] = surface - 0.002, -1.0
    state[3, 2], state[3, 5] = surface - 0.002, 1.0
    state[4, 2], state[4, 5] = surface - 0.01, 0.01
    state[5, 2], state[5, 5] = -0.3, -1.0
    state[6, 2], state[6, 5] = surface + 0.2, -1.0
    worst = apart(model, state, TIMES, table).amax(1)
    assert float(worst.max()) < 1e-5


def test_the_edge_of_the_table(build) -> None:
    """Two balls side by side, one comes down on the table, the other on the floor."""
    model = build(gravity={}, drag={"k": 0.1}, restitution={"e": 0.9})
    state = torch.tensor(
        [[0.0, 0.0, 0.3, 2.0, 0, 0, 0, 0, 0], [0.5, 0.0, 0.3, 2.5, 0, 0, 0, 0, 0]], dtype=torch.float64
    )
    surfaces = Surfaces(0.0, -0.76, extent=(-1.0, 1.0, -1.0, 1.0))
    assert float(apart(model, state, TIMES, surfaces).max()) < 1e-5
    with torch.no_grad():
        found = paths(model, state, TIMES, surfaces)
    assert float(found[1, :, 2].min()) < -0.6
    assert float(found[0, TIMES < 0.4, 2].min()) > 0.0


def test_coefficients_of_each_ball(model, states, table) -> None:
    """An augmented model: each row with its own coefficients, as a model that has them."""
    names = ("flight.drag.k", "bounce.restitution.e")
    augmented, state = AugmentedModel(model, names), states(3)
    own = torch.tensor([[0.10, 0.93], [0.15, 0.80], [0.13, 0.88]], dtype=torch.float64)
    with torch.no_grad():
        found = paths(augmented, augmented.append(state, own), TIMES, table)
        for k in range(3):
            one = substitute(model, dict(zip(names, own[k], strict=True)))
            alone = paths(one, state[k : k + 1], TIMES, table)[0]
            torch.testing.assert_close(found[k, :, :9], alone, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(found[..., 9:], own[:, None].expand(3, len(TIMES), 2), rtol=0, atol=1e-15)


def test_long_times(build) -> None:
    """Beyond the longest motion a ball lies where it was, as in a rollout."""
    model = build(gravity={}, restitution={"e": 0.5}, friction={"mu": 0.25})
    state = torch.tensor([[0.0, 0.0, 0.5, 1.0, 0, 0, 0, 0, 0]], dtype=torch.float64)
    times = torch.tensor([0.3, 5.0, 25.0], dtype=torch.float64)
    assert float(apart(model, state, times, Surfaces(0.0)).max()) < 1e-9


def test_bad_times_are_told(model, states, table) -> None:
    for times in ([0.2, 0.1], [-0.1, 0.1]):
        with pytest.raises(ValueError, match="times must start at 0 or later and must not decrease"):
            paths(model, states(2), torch.tensor(times, dtype=torch.float64), table)
