"""Compiled functions of models against torch: every effect, effects of users, and what cannot be compiled."""

import copy
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

from ballfg.diagnosis.fit.effects import has_effect, with_effects
from ballfg.dynamics import EFFECTS, AnalyticModel, Surfaces, nominal_model, rollout
from ballfg.dynamics.compiled import functions
from ballfg.dynamics.compiled.build import built
from ballfg.dynamics.compiled.functions import compiled
from ballfg.dynamics.compiled.kept import cache_folder
from ballfg.dynamics.compiled.motion import functions_of
from ballfg.dynamics.domain import Domain
from ballfg.dynamics.effect import Coefficient, FlightEffect
from ballfg.dynamics.effects.registry import GENERIC, LEARNED
from ballfg.dynamics.model import substitute
from ballfg.dynamics.motion.by_machine_code import fly_jacobian
from ballfg.dynamics.motion.contact import fly_through
from ballfg.dynamics.motion.integrate import fly
from ballfg.estimation.segmentation.physics import physics_of
from tests.dynamics.in_tensors import fly_through_jacobian

MOTION = {name: effect for name, effect in {**EFFECTS, **GENERIC, **LEARNED}.items() if effect.kind != "measurement"}


def model_with(*effects):
    nominal = nominal_model()
    model = with_effects(nominal, *(e() for e in effects if not has_effect(nominal, e.name)))
    rng, declared = np.random.default_rng(1), model.declared_coefficients()
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            parameter += 0.2 * declared[name].sigma * rng.normal()
    return model.requires_grad_(False)


def states(count=12):
    rng = np.random.default_rng(2)
    made = rng.normal(size=(count, 9)) * np.repeat((0.5, 3.0, 100.0), 3)
    made[:, 2], made[:, 5] = 1.0, -2.0 - np.abs(made[:, 5])
    return torch.from_numpy(made)


def agree(model) -> None:
    """Flights and bounces, and their Jacobians, are those that autograd finds for torch's own motion."""
    state, dt = states(), torch.full((12,), 0.031, dtype=torch.float64)
    known = functions_of(model)
    assert known is not None
    after, jacobian = fly_jacobian(model, known, state, dt)
    torch.testing.assert_close(after, fly(model, state, dt), rtol=1e-12, atol=1e-12)
    right = torch.autograd.functional.jacobian(lambda x: fly(model, x, dt).sum(0), state).transpose(0, 1)
    torch.testing.assert_close(jacobian, right, rtol=1e-10, atol=1e-10)
    dt = torch.full((12,), 0.15, dtype=torch.float64)
    after, times, jacobian = fly_through_jacobian(model, state, dt, (0.76,))
    whole, when = fly_through(model, state, dt, (0.76,))
    torch.testing.assert_close(times, when, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(after, whole, rtol=1e-10, atol=1e-10)
    right = torch.autograd.functional.jacobian(lambda x: fly_through(model, x, dt, (0.76,))[0].sum(0), state)
    torch.testing.assert_close(jacobian, right.transpose(0, 1), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.thorough] * (n in EFFECTS)) for n in MOTION])
def test_every_effect(name) -> None:
    """Those of the catalogue stand together in the next test, which the quick suite has too."""
    agree(model_with(MOTION[name]))


def test_many_effects_together() -> None:
    agree(model_with(*(effect for name, effect in EFFECTS.items() if name in MOTION)))


class Pull(FlightEffect):
    """A force that a user wrote, with a number that is no coefficient."""

    name = "pull"
    sentence = decide = "Only a test."
    coefficients = (Coefficient("k", 0.3, 0.1, "m/s^2", -5.0, 5.0),)

    def __init__(self, power: float) -> None:
        super().__init__()
        self.power = power

    def acceleration(self, flight):
        return self.k * torch.tanh(flight.position) ** self.power


class Rounded(Pull):
    """A force that asks torch for what no rule covers."""

    name = "rounded"

    def acceleration(self, flight):
        return self.k * torch.special.i0(flight.position)


def ball(effect):
    return AnalyticModel([EFFECTS["gravity"](), effect, EFFECTS["restitution"]()]).requires_grad_(False)


def test_an_effect_of_a_user_and_its_own_numbers() -> None:
    for power in (2, 3):
        agree(ball(Pull(power)))


def test_what_no_rule_covers_runs_in_torch_and_says_so() -> None:
    model = ball(Rounded(2))
    with pytest.warns(UserWarning, match="runs in torch.*i0"):
        assert compiled(model) is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert compiled(model) is None  # said once
        assert compiled(copy.deepcopy(model)) is None


def test_copies_share_functions_and_take_their_own_coefficients() -> None:
    model = nominal_model().requires_grad_(False)
    other = copy.deepcopy(model)
    other.domain = Domain({"speed": (2.0, 9.0)})  # as every fitted model has: it does not belong to the motion
    assert compiled(other) is compiled(model)
    with torch.no_grad():
        dict(other.named_parameters())["flight.drag.k"].fill_(0.4)
    agree(other)


def test_substituted_coefficients_stay_in_torch() -> None:
    rows = torch.full((12, 1), 0.1, dtype=torch.float64)
    assert compiled(substitute(nominal_model(), {"flight.drag.k": rows})) is None


def test_code_that_differs_from_torch_is_refused(monkeypatch) -> None:
    right = functions._traced

    def wrong(*args):
        made = right(*args)
        source = made.source.replace("y[r, 0] = ", "y[r, 0] = 1e-6 + ")
        return replace(made, source=source, compute=built(source))

    monkeypatch.setattr(functions, "_traced", wrong)
    with pytest.warns(UserWarning, match="differs from torch"):
        assert compiled(ball(Pull(5))) is None


def test_an_effect_that_was_edited_is_traced_again(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("BALLFG_CACHE", str(tmp_path))
    cache_folder.cache_clear()
    try:
        agree(ball(Pull(7)))
        functions._by_structure.clear()
        monkeypatch.setattr(Pull, "acceleration", lambda self, flight: self.k * torch.sin(flight.velocity))
        agree(ball(Pull(7)))
    finally:
        cache_folder.cache_clear()


def test_a_class_that_is_defined_again_has_functions_of_its_own() -> None:
    """As in a repeated cell of a notebook: module and name stay."""
    for law in (torch.sin, torch.cos):
        again = type("Again", (Pull,), {"acceleration": lambda self, flight, law=law: self.k * law(flight.velocity)})
        agree(ball(again(2)))


def test_what_agreed_is_compared_again_for_classes_of_others_alone(monkeypatch, tmp_path) -> None:
    """The sources of ballfg's classes are in the key of the note; a user's class, or a replaced method, is compared."""
    monkeypatch.setenv("BALLFG_CACHE", str(tmp_path))
    cache_folder.cache_clear()
    try:
        own, other = nominal_model().requires_grad_(False), ball(Pull(4))
        asked, every = list[AnalyticModel](), len(functions.PARTS) + 1  # each function, then steps by all of them
        functions._by_structure.clear()
        first = compiled(own), compiled(other)
        monkeypatch.setattr(functions, "_compare", lambda model, *_: asked.append(model))
        monkeypatch.setattr(functions, "_compare_steps", lambda model, _: asked.append(model))
        for _ in range(2):
            functions._by_structure.clear()
            asked.clear()
            again = compiled(copy.deepcopy(own)), compiled(copy.deepcopy(other))
            assert [known.rates.source for known in again] == [known.rates.source for known in first]
            assert len(asked) == every
            assert all("pull" in dict(model.flight.named_children()) for model in asked)
        drag = type(own.flight["drag"])
        monkeypatch.setattr(drag, "acceleration", lambda self, flight: -self.k * flight.velocity)
        functions._by_structure.clear()
        asked.clear()
        compiled(copy.deepcopy(own))
        assert len(asked) == every
    finally:
        cache_folder.cache_clear()


def test_another_effect_or_radius_is_seen() -> None:
    model = nominal_model().requires_grad_(False)
    start = torch.tensor([[0.0, 0.0, 0.3, 3.0, 0.5, 2.0, 0.0, 80.0, 20.0]], dtype=torch.float64)
    times = torch.tensor([0.4, 1.0], dtype=torch.float64)

    def known() -> torch.Tensor:
        with torch.no_grad():
            quick = rollout(model, start, times, Surfaces(0.0))
        with torch.enable_grad():  # torch does the work
            torch.testing.assert_close(quick, rollout(model, start, times, Surfaces(0.0)), rtol=0, atol=1e-9)
        return quick

    before = known()
    model.flight["drag"] = EFFECTS["drag"](k=0.5).requires_grad_(False)
    slower = known()
    assert (slower - before).abs().max() > 0.1
    assert physics_of(model).drag == pytest.approx(0.5)
    model.radius = 0.1
    assert (known() - slower).abs().max() > 0.01
    assert physics_of(model).radius == 0.1
