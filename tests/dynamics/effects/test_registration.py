"""Effects of one's own: what is registered, what is refused and in which words, and that other processes get them."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from cloudpickle import dumps  # what worker processes are sent with

from ballfg.dynamics import EFFECTS, Coefficient, FlightEffect, load_effects, nominal_model, register
from ballfg.dynamics.measurement import Later, MeasurementEffect
from ballfg.dynamics.model_file import model_from_dict

LIFT = '''"""Two effects, the second of which changes the first; a base of both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, FlightEffect

FACTOR = 2.0


@dataclass
class Scale:
    kind: ClassVar[int] = 1
    size: float = 3.0


class _Lift(FlightEffect):
    coefficients = (Coefficient("a", 0.0, 0.1, "m/s^2", -5.0, 5.0),)

    def acceleration(self, flight: Flight) -> Tensor:
        return FACTOR * Scale().size * self.a * torch.ones_like(flight.velocity)


class Lift(_Lift):
    name = "own_lift"
    sentence = "Something lifts the ball."
    decide = "Ask it to stop."


class MoreLift(_Lift):
    name = "own_more_lift"
    sentence = "Something else lifts the ball."
    decide = "Ask both to stop."
    needs = ("own_lift",)
'''


@pytest.fixture(autouse=True)
def registry():
    """What a test registers is forgotten."""
    with EFFECTS.restored():
        yield


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "lifts.py"
    path.write_text(LIFT, encoding="utf-8")
    return path


def push(**changes: object) -> type[FlightEffect]:
    """An effect with some of its attributes changed; one that is None is left out."""
    body: dict[str, object] = {
        "name": "own_push",
        "sentence": "A push.",
        "decide": "Do not push.",
        "coefficients": (Coefficient("a", 0.0, 0.1, "m/s^2", -5.0, 5.0),),
        "acceleration": lambda self, flight: self.a * torch.ones_like(flight.velocity),
    }
    body = {name: value for name, value in (body | changes).items() if value is not None}
    return type("Push", (FlightEffect,), body)


def test_all_effects_of_a_file_are_known_afterwards(file: Path) -> None:
    builtin = list(EFFECTS)
    effects = load_effects(file)
    assert [effect.name for effect in effects] == ["own_lift", "own_more_lift"]
    assert list(EFFECTS) == [*builtin, "own_lift", "own_more_lift"]
    model = model_from_dict({"flight": {"own_lift": {"a": 0.5}, "own_more_lift": {}}, "bounce": {}})
    assert model.rates(torch.zeros(1, 9, dtype=torch.float64))[0].tolist() == [[3.0, 3.0, 3.0]]
    assert not [name for name in sys.modules if "lifts.py" in name]
    assert [path.name for path in file.parent.iterdir()] == ["lifts.py"]


def test_twice_is_once(file: Path) -> None:
    load_effects(file)
    known = list(EFFECTS)
    again = load_effects(file)
    assert list(EFFECTS) == known
    assert EFFECTS["own_lift"] is again[0]  # an edited file counts as it stands now
    effect = push()
    assert register(effect) is register(effect) is effect
    anew = register(push())
    assert EFFECTS["own_push"] is anew


def test_workers_get_the_effects(file: Path, tmp_path: Path) -> None:
    """A model with effects of a file crosses to a process that never saw the file."""
    load_effects(file)
    model = model_from_dict({"flight": {"own_lift": {"a": 0.5}}, "bounce": {}})
    (tmp_path / "model").write_bytes(dumps(model))
    file.unlink()
    code = (
        "import pickle, sys, torch; model = pickle.load(open(sys.argv[1], 'rb'));"
        "print(model.rates(torch.zeros(1, 9, dtype=torch.float64))[0].tolist())"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "model"], capture_output=True, text=True, check=True)
    assert done.stdout == "[[3.0, 3.0, 3.0]]\n"


def test_no_effect(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"^effect must be a subclass of FlightEffect, .*; got 3\. docs/add_an_effect"):
        register(3)
    with pytest.raises(TypeError, match=r"^effect must be a subclass of FlightEffect, .*Coefficient"):
        register(Coefficient)
    path = tmp_path / "empty.py"
    path.write_text("from ballfg.dynamics.effects.flight import Wind\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"empty\.py must define an effect, a class; it defines none\. docs/"):
        load_effects(path)


COEFFICIENT = Coefficient("a", 0.0, 0.1, "m/s^2", -5.0, 5.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": None}, r"^Push\.name must be a text; it is missing\. "),
        ({"sentence": " "}, r"^Push\.sentence must be a text; it is missing\. "),
        ({"decide": None}, r"^Push\.decide must be a text; it is missing\. "),
        ({"name": "own push"}, r"^Push\.name must be letters, digits and _; got 'own push'\. Rename it\.$"),
        ({"kind": "bounce"}, r"^Push\.kind must be that of its base, 'flight'; got 'bounce'\. Leave it out\.$"),
        ({"coefficients": None}, r"^own_push\.coefficients must be a tuple of Coefficient; got None\. "),
        ({"coefficients": (0.3,)}, r"^own_push\.coefficients must be a tuple of Coefficient; got \(0\.3,\)\. "),
        ({"coefficients": (COEFFICIENT,) * 2}, r"^own_push\.a must be a name of its own; "),
        ({"coefficients": (dataclasses.replace(COEFFICIENT, name="training"),)}, r"^own_push\.training must be a name"),
        ({"coefficients": (dataclasses.replace(COEFFICIENT, name="name"),)}, r"^own_push\.name must be a name of its"),
        ({"coefficients": (dataclasses.replace(COEFFICIENT, low=1.0),)}, r"^own_push\.a must have low <= default <="),
        ({"coefficients": (dataclasses.replace(COEFFICIENT, sigma=-1.0),)}, r"^own_push\.a must have low <= default"),
        (
            {"coefficients": (dataclasses.replace(COEFFICIENT, sigma=0.0),)},
            r"^own_push\.a\.sigma must be above 0, a pl",
        ),
        ({"coefficients": (dataclasses.replace(COEFFICIENT, absent=9.0),)}, r"^own_push\.a\.absent must lie within "),
        ({"coefficients": (dataclasses.replace(COEFFICIENT, absent=None),)}, r"^own_push must have a coefficient that"),
        (
            {"name": "wind"},
            r"^name of an effect must be its own; got 'wind', that of ballfg\.dynamics\.effects\.flight\.W",
        ),
        ({"name": "generic_flight"}, r"^name of an effect must be its own; got 'generic_flight', that of "),
        ({"needs": ("gale",)}, r"^own_push\.needs must name known effects; got 'gale'\. Register that one first"),
    ],
)
def test_what_is_refused(changes: dict[str, object], message: str) -> None:
    known = dict(EFFECTS)
    with pytest.raises(ValueError, match=message):
        register(push(**changes))
    assert known == EFFECTS


def test_files_that_do_not_run(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.py does not exist; effects of one's own are one Python file"):
        load_effects(tmp_path / "none.py")
    with pytest.raises(FileNotFoundError, match=r"^effects file must be one Python file; .* is a folder\. Give a file"):
        load_effects(tmp_path)
    broken = tmp_path / "broken.py"
    broken.write_text("x = 1\ny = (\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"broken\.py must run as Python; line 2: SyntaxError: .*\. Mend it there\.$"):
        load_effects(broken)
    broken.write_text("def f():\n    return 1 / 0\n\nf()\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"broken\.py must run as Python; line 2: ZeroDivisionError: division by zero"):
        load_effects(broken)
    broken.write_text(LIFT.replace('"own_lift"\n', '"wind"\n'), encoding="utf-8")
    with pytest.raises(ValueError, match=r"broken\.py: name of an effect must be its own; got 'wind', that of "):
        load_effects(broken)
    assert not [name for name in sys.modules if "broken.py" in name]


def test_names_of_two_files_must_differ(file: Path, tmp_path: Path) -> None:
    load_effects(file)
    other = tmp_path / "other.py"
    other.write_text(LIFT, encoding="utf-8")
    with pytest.raises(
        ValueError, match=r"other\.py: name of an effect must be its own; got 'own_lift', that of .*lifts"
    ):
        load_effects(other)


def test_a_measurement_effect_and_a_decorator() -> None:
    @register
    class Echo(MeasurementEffect):
        name = "own_echo"
        sentence = "Positions are read twice."
        decide = "Listen."
        coefficients = (Coefficient("share", 0.0, 0.1, "1", -1.0, 1.0),)

        def positions(self, states: torch.Tensor, later: Later) -> torch.Tensor:
            return (1.0 + self.share) * states[..., :3]

    model = nominal_model()
    content = {"flight": {"gravity": {}}, "bounce": {}, "measurement": {"own_echo": {"share": 0.2}}}
    assert isinstance(model_from_dict(content, radius=model.radius).measurement["own_echo"], Echo)


def test_an_unknown_effect_says_how_to_make_it_known() -> None:
    with pytest.raises(ValueError, match=r"of your own must be registered first: --effects-file FILE\.py, or ballfg"):
        model_from_dict({"flight": {"own_lift": {}}, "bounce": {}})


@pytest.mark.parametrize(
    ("method", "message"),
    [
        (
            "def accelerate(self, flight): return -self.a * flight.velocity",
            "Silent must have one of the methods air_velocity, adj",
        ),
        (
            "def acceleration(self, flight): return -self.a * flight.speed",
            r"Silent.acceleration must return \(..., 3\) in float64, of a batch of two balls \(2, 3\); got \(2, 1\), ",
        ),
        (
            "def spin_rate(self, flight): return (self.a * flight.spin).float()",
            r"Silent.spin_rate .* \(2, 3\), torch.fl",
        ),
        ("def air_velocity(self, flight): return [1.0, 0.0, 0.0]", "Silent.air_velocity must return .* got list"),
        ("def acceleration(self, flight): return flight.drag", "Silent.acceleration must take a batch .*no attribute"),
    ],
    ids=["misspelt", "one column", "single precision", "list", "raises"],
)
def test_an_effect_that_would_do_nothing_or_act_along_every_axis_is_refused(
    tmp_path: Path, method: str, message: str
) -> None:
    words = 'name = "silent"; sentence = "It does nothing."; decide = "Look."'
    coefficients = 'coefficients = (Coefficient("a", 0.5, 0.1, "1/s", -5.0, 5.0),)'
    head = "from ballfg.dynamics import Coefficient, FlightEffect\n\n\nclass Silent(FlightEffect):\n"
    (tmp_path / "silent.py").write_text(f"{head}    {words}\n    {coefficients}\n    {method}\n", encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        load_effects(tmp_path / "silent.py")
    assert "silent" not in EFFECTS
