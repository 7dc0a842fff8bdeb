"""The code, tables and numbers in docs/ hold."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
import yaml

from ballfg.dynamics import EFFECTS, AnalyticModel, nominal_model
from ballfg.dynamics.model_file import model_from_dict, model_to_dict
from ballfg.dynamics.motion.integrate import fly
from ballfg.dynamics.motion.rollout import advance
from ballfg.dynamics.surfaces import Surfaces
from ballfg.simulation import parse_effects
from ballfg.tracks import TABLE_TENNIS
from tests.places import DOCS


def blocks(page, language):
    return re.findall(
        rf"^```{language}\n(.*?)^```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )


def test_model_file_example_loads():
    text, variations, populations = blocks("models.md", "yaml")
    content = yaml.safe_load(text)
    assert model_to_dict(model_from_dict(content)) == content
    content = {**content, **yaml.safe_load(variations)}
    assert model_to_dict(model_from_dict(content))["variations"] == content["variations"]
    content = {**content, **yaml.safe_load(populations)}
    assert model_to_dict(model_from_dict(content))["populations"] == content["populations"]


def test_model_code_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (code,) = blocks("models.md", "python")
    names = {}
    exec(compile(code, "models.md", "exec"), names)
    assert model_to_dict(names["model"]) == model_to_dict(nominal_model())


@pytest.fixture
def example(tmp_path, monkeypatch):
    """The example effect of the guide, from a file as a user has it; the guide's model with it."""
    monkeypatch.chdir(tmp_path)
    code, use = blocks("add_an_effect.md", "python")
    Path("static_charge.py").write_text(code, encoding="utf-8")
    names = {}
    declared = {"strength": 1.0, "reach": 0.1, "surface": 0.76}
    with EFFECTS.restored():
        exec(compile(use, "add_an_effect.md", "exec"), names)
        assert model_to_dict(names["model"])["flight"]["static_charge"] == declared
        (text,) = blocks("add_an_effect.md", "yaml")
        yield model_from_dict(yaml.safe_load(text))


def test_example_effect_does_what_it_says(example):
    state = torch.tensor([[0, 0, 0.76, 1, 0, 0, 0, 0, 0], [0, 0, 0.96, 1, 0, 0, 0, 0, 0]], dtype=torch.float64)
    without = AnalyticModel([e for n, e in example.flight.items() if n != "static_charge"])
    added = example.rates(state)[0] - without.rates(state)[0]
    assert added[:, :2].abs().max() == 0.0
    assert added[:, 2].tolist() == pytest.approx([-1.0, -0.2])


def test_example_effect_is_found_everywhere(example):
    assert model_to_dict(example)["flight"]["static_charge"]["strength"] == 1.0
    state = torch.tensor([[0, 0, 1.0, 4, 0, -1.0, 0, 50, 0]], dtype=torch.float64)
    after = advance(example, state, torch.tensor([0.3], dtype=torch.float64), Surfaces(0.76))
    strength = dict(example.named_parameters())["flight.static_charge.strength"]
    (gradient,) = torch.autograd.grad(after[0, 0], strength)
    assert gradient.item() != 0.0
    (undeclared,) = parse_effects(["static_charge.strength=2"])
    assert undeclared.strength.item() == 2.0


def test_example_effect_has_right_derivatives(example):
    state = torch.tensor([[0, 0, 0.9, 4, 0, -3.0, 0, 50, 0]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda s, *_: example.rates(s)[0], (state, *example.flight.parameters()))


def test_nominal_values_in_the_physics_page():
    text = (DOCS / "physics.md").read_text(encoding="utf-8").partition("## Balls")[0]
    nominal = {row[0]: row[1] for row in re.findall(r"^\| ([^|]+?) \| ([^|]+?) \|", text, re.MULTILINE)}
    model = nominal_model()
    for start, value in (
        ("gravity", f"{model.flight['gravity'].g.item():g} m/s²"),
        ("drag", f"{model.flight['drag'].k.item():g} 1/m"),
        ("Magnus", f"{model.flight['magnus'].k.item():g}"),
        ("restitution", f"{model.bounce['restitution'].e.item():g}"),
        ("friction", f"{model.bounce['friction'].mu.item():g}"),
        ("tangential restitution", f"{model.bounce['tangential_restitution'].e_t.item():g}"),
        ("table height", f"{1000 * model.bounce['table_height'].offset.item():g} mm"),
        ("radius", f"{model.radius:.3f} m"),
    ):
        shown = next(v for k, v in nominal.items() if k.startswith(start))
        assert shown == value, start


def test_the_law_by_spin_in_the_physics_page_loads():
    """Its gravity is that of the page's formula for a table-tennis ball in air of 1.2 kg/m^3."""
    law, _ = blocks("physics.md", "yaml")
    content = yaml.safe_load(law)
    assert model_to_dict(model_from_dict(content)) == content
    ball, air = TABLE_TENNIS, 1.2 * 4 / 3 * torch.pi * TABLE_TENNIS.radius**3
    assert content["flight"]["gravity"]["g"] == pytest.approx(9.81 * ball.mass / (ball.mass + 1.5 * air), abs=0.005)


SLOW_AND_FAST = ((6.0, 50.0), (12.0, 100.0))
"""m/s and rev/s of topspin, the balls of the table "How much it matters"."""


def ends(model, *, seconds=0.5, turn=None):
    """(2, 3) m: where level shots of the two balls are after half a second, in the frame that is turned by `turn`."""
    state = torch.zeros(2, 9, dtype=torch.float64)
    state[:, 3] = torch.tensor([speed for speed, _ in SLOW_AND_FAST])
    state[:, 7] = 2.0 * torch.pi * torch.tensor([turns for _, turns in SLOW_AND_FAST])
    turn = torch.eye(3, dtype=torch.float64) if turn is None else turn
    state = (state.reshape(2, 3, 3) @ turn).reshape(2, 9)
    with torch.no_grad():
        return fly(model, state, torch.full((2,), seconds, dtype=torch.float64))[:, :3] @ turn.T


def changed(**coefficients):
    content = model_to_dict(nominal_model())
    for name, value in coefficients.items():
        effect, coefficient = name.split("__")
        content["flight"].setdefault(effect, {})[coefficient] = value
    return model_from_dict(content)


def test_how_much_effects_matter_in_the_physics_page():
    text = (
        (DOCS / "physics.md").read_text(encoding="utf-8").partition("## How much it matters")[2].partition("\n## ")[0]
    )
    table = dict(re.findall(r"^\| ([^|]+?) \| ([\d /]+?) \|", text, re.MULTILINE))
    nominal, angle = nominal_model(), torch.tensor(0.5 * torch.pi / 180.0, dtype=torch.float64)
    flight = model_to_dict(nominal)["flight"]
    one, zero = torch.ones((), dtype=torch.float64), torch.zeros((), dtype=torch.float64)
    # about the direction of the shot, so that gravity gains a part across it
    tilt = torch.stack((one, zero, zero, zero, angle.cos(), -angle.sin(), zero, angle.sin(), angle.cos())).reshape(3, 3)
    moved = {
        "Magnus +10 %": ends(changed(magnus__k=1.1 * flight["magnus"]["k"])),
        "drag +10 %": ends(changed(drag__k=1.1 * flight["drag"]["k"])),
        "tail wind 0.2 m/s": ends(changed(wind__x=0.2)),
        "spin decay with a time constant of 5 s": ends(changed(spin_decay__rate=0.2)),
        "tilt of the frame 0.5°": ends(nominal, turn=tilt),
    }
    for row, places in moved.items():
        millimetres = 1000.0 * (places - ends(nominal)).norm(dim=-1)
        assert table[row] == " / ".join(f"{value:.0f}" for value in millimetres), row
    assert table["time offset 1 ms"] == " / ".join(f"{speed:.0f}" for speed, _ in SLOW_AND_FAST)
