"""What the classes of effects know: complete for those of the package, optional for those of a user."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from ballfg.benchmarks.diagnosis.cases import PLANTS
from ballfg.diagnosis.report.wording import in_plain_words, plain_name
from ballfg.diagnosis.result import Finding, Value
from ballfg.diagnosis.search.ranking import implausible, range_of
from ballfg.dynamics import EFFECTS, Coefficient, Flight, FlightEffect, MeasurementEffect, Range, Usual, register
from ballfg.dynamics.effects import registry
from ballfg.dynamics.wording import said

OWN = {name: effect for name, effect in EFFECTS.items() if effect.__module__.startswith("ballfg.")}
HEIGHT = Value(0.004, 0.001, "m")


@pytest.mark.parametrize("name", OWN)
def test_an_effect_of_the_package_knows_everything(name: str) -> None:
    effect = OWN[name]
    strengths = {c.name: c for c in effect.coefficients if c.absent is not None}
    assert effect.plain and effect.says.endswith(".")  # noqa: PT018
    assert effect.belongs_to in ("ball", "room", "rig")
    if not name.startswith("spin_label"):  # a label may be in any unit, with any error
        assert effect.plausible is not None
        assert effect.plausible.source
        for c in strengths.values():
            assert effect.plausible.low <= c.default <= effect.plausible.high
            assert not implausible(f"{name}.{c.name}", Value(c.default, c.sigma, c.unit), 0.02)
    if name == "counted_frames":  # seen in the stamps, in any number; nobody knows a usual one
        assert effect.usual is None
        return
    assert effect.usual is not None
    assert effect.usual.source
    for coefficient, change in effect.usual.change.items():
        known = strengths[coefficient]
        start = known.absent if known.sigma else known.default
        assert known.low <= start + change <= known.high
        assert change != 0.0
        if effect.plausible is not None:
            wide = (effect.plausible.high - effect.plausible.low) / 10  # gravity off by 1 % is to be refused by little
            assert effect.plausible.low - wide <= start + change <= effect.plausible.high + wide
    assert PLANTS[name].amounts == tuple(effect.usual.change.items())


def test_a_module_in_the_folder_needs_no_entry_anywhere() -> None:
    """The registry lists what the modules define, in the order of kinds."""
    kinds = [effect.kind for effect in OWN.values()]
    assert kinds == sorted(kinds, key=["flight", "bounce", "measurement"].index)
    assert not set(registry.GENERIC) & set(OWN)


class Bare(FlightEffect):
    name = "bare_pull"
    sentence = "The sea pulls. It is far."
    decide = "Leave the sea."
    coefficients = (Coefficient("a", 0.0, 0.5, "m/s^2", -20.0, 20.0),)

    def acceleration(self, flight: Flight) -> Tensor:
        return self.a * torch.ones_like(flight.velocity)


class Knowing(Bare):
    name = "knowing_pull"
    plain = "a pull of the sea"
    says = "The sea {a:pulls|pushes} with {a:abs .1f} m/s²."
    plausible = Range(0.0, 1.0, "nobody was pulled in by more")
    usual = Usual({"a": 0.1}, "a guess")
    belongs_to = "room"


def finding(name: str, value: float) -> Finding:
    values = {"a": Value(value, 0.01, "m/s^2")}
    return Finding(name, "flight", values, 0.0, 0.0, (), 0.0, 0.0, Bare.sentence, Bare.decide)


def test_what_an_effect_of_a_user_knows_is_optional_and_used_where_it_is_there() -> None:
    with EFFECTS.restored():
        register(Bare)
        register(Knowing)
        assert (plain_name("bare_pull"), plain_name("knowing_pull")) == ("bare pull", "a pull of the sea")
        assert in_plain_words(finding("bare_pull", -2.0)) == "The sea pulls (a -2.000 ± 0.010 m/s^2)."
        assert in_plain_words(finding("knowing_pull", -2.0)) == "The sea pushes with 2.0 m/s²."
        assert (range_of("bare_pull.a", 0.02), range_of("knowing_pull.a", 0.02)) == (None, Knowing.plausible)
        assert "nobody was pulled in by more" in implausible("knowing_pull.a", Value(9.0, 0.01, "m/s^2"), 0.02)
        assert (Bare.belongs_to, Knowing.belongs_to) == ("ball", "room")


@pytest.mark.parametrize(
    ("attribute", "wrong", "text"),
    [
        ("says", "It pulls with {strength}.", r"says must have fields such as \{a:\.2g\}"),
        ("says", "It pulls with {a:nonsense}.", "says must have fields"),
        ("belongs_to", "rig", "belongs_to must be ball or room"),
        ("plausible", (0.0, 1.0), "plausible must be a Range"),
        ("usual", Usual({"b": 1.0}, "x"), "usual must be a Usual of a"),
    ],
)
def test_wrong_knowledge_is_refused_when_the_effect_is_registered(attribute: str, wrong: object, text: str) -> None:
    cls = type("Wrong", (Knowing,), {"name": "wrong_pull", "__module__": __name__, attribute: wrong})
    with EFFECTS.restored(), pytest.raises(ValueError, match=text):
        register(cls)


def test_an_effect_of_measurement_belongs_to_the_rig() -> None:
    cls = type(
        "Mine",
        (MeasurementEffect,),
        {"name": "my_error", "sentence": "s", "decide": "d", "coefficients": Bare.coefficients, "belongs_to": "room"},
    )
    with EFFECTS.restored(), pytest.raises(ValueError, match="belongs_to must be rig"):
        register(cls)


@pytest.mark.parametrize(
    ("says", "expected"),
    [
        ("{x:.3f} {x:abs .1f} {x:points} {x:%} {x:milli}", "-0.300 0.3 30 30 % 300"),
        ("{x:up|down} {y:up|down} {z:up|down}", "down up up"),
        ("{size:.2g} {direction} {apart:.2g} {degrees}", "0.5 with x -0.3, y 0.4, z 0 0.7 29°"),
        ("{axes:long|short}", "30 % too short along x, 40 % too long along y"),
        ("{k:lost}", "63 %"),
    ],
)
def test_fields_of_sentences(says: str, expected: str) -> None:
    values = {axis: Value(v, 0.01, "1") for axis, v in zip("xyz", (-0.3, 0.4, 0.0), strict=True)}
    assert said(says, {**values, "k": Value(1.0, 0.1, "1/s")}) == expected
    one = {"x": Value(0.0, 0.1, "1"), "y": Value(-0.2, 0.1, "1"), "z": Value(0.01, 0.1, "1")}
    assert said("{direction}", one) == "along -y"
