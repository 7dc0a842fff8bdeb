"""Model files: what goes in comes out, and what is wrong is said."""

from __future__ import annotations

import pytest
import yaml

from ballfg.dynamics import EFFECTS, load_model, nominal_model, save_model
from ballfg.dynamics.model_file import model_from_dict, model_to_dict

GOOD = """
flight: {gravity: {g: 9.80}, drag: {k: 0.13}, magnus: {}}
bounce: {restitution: {e: 0.9}, friction: null}
measurement: {}
learned: null
"""


@pytest.fixture
def write(tmp_path):
    def make(text):
        path = tmp_path / "model.yaml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return make


def test_values_and_defaults(write):
    model = load_model(write(GOOD), radius=0.033, inertia_factor=0.5)
    assert (model.radius, model.inertia_factor) == (0.033, 0.5)
    assert list(model.flight) == ["gravity", "drag", "magnus"]
    assert list(model.bounce) == ["restitution", "friction"]
    assert model.flight["gravity"].g.item() == 9.80
    assert model.flight["magnus"].k.item() == EFFECTS["magnus"].coefficients[0].default
    assert model.bounce["friction"].mu.item() == EFFECTS["friction"].coefficients[0].default


def test_round_trip(model, tmp_path):
    path = tmp_path / "saved.yaml"
    values = dict(model.named_parameters())
    values["flight.magnus.k"].data.fill_(1.25e-5 / 3)  # an exponent, and every digit
    save_model(model, path)
    again = load_model(path)
    assert model_to_dict(again) == model_to_dict(model)
    for name, value in again.named_parameters():
        assert value.item() == values[name].item()
    assert [p.name for p in tmp_path.iterdir()] == ["saved.yaml"]


def test_saving_replaces_a_file_whole(model, tmp_path):
    path = tmp_path / "saved.yaml"
    path.write_text("old")
    save_model(model, path)
    assert set(yaml.safe_load(path.read_text())) == {"flight", "bounce", "measurement", "learned"}


def test_every_effect_in_a_file(tmp_path):
    """Values away from the defaults come back; an effect without values changes nothing."""
    content = {"flight": {}, "bounce": {}, "measurement": {}, "learned": None}
    for name, effect in EFFECTS.items():
        content[effect.kind][name] = {c.name: c.default + (c.high - c.default) / 7 for c in effect.coefficients}
    path = tmp_path / "all.yaml"
    save_model(model_from_dict(content), path)
    assert model_to_dict(load_model(path)) == content
    assert set(load_model(path).declared_coefficients()) == {n for n, _ in load_model(path).named_parameters()}


def test_optional_sections():
    assert list(model_from_dict({"flight": {}, "bounce": {}}).flight) == []


def test_nominal_model_is_what_the_effects_say():
    """The shipped file holds each effect's default, but for the table's height, whose default is `as declared`."""
    for section, effects in model_to_dict(nominal_model()).items():
        for name, values in (effects or {}).items():
            assert EFFECTS[name].kind == section
            for c in EFFECTS[name].coefficients:
                assert name == "table_height" or values[c.name] == c.default


def test_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"^model file .*none\.yaml does not exist; a model is one YAML file$"):
        load_model(tmp_path / "none.yaml")
    with pytest.raises(FileNotFoundError, match=r"must be one YAML file; .* is a folder\. Give a file in it\.$"):
        load_model(tmp_path)
    (tmp_path / "model.yaml").mkdir()  # no file: nothing to give
    with pytest.raises(FileNotFoundError, match=r"Give a file in it\.$"):
        load_model(tmp_path)
    (tmp_path / "model.yaml").rmdir()
    (tmp_path / "model.yaml").write_text("flight: {}")
    with pytest.raises(FileNotFoundError, match=rf"is a folder\. Give {tmp_path}/model\.yaml\.$"):
        load_model(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("flight: {gravity: [", r"not readable as YAML \(while parsing"),
        (b"\xff\xfe\x00", r"not readable as YAML \("),
        (
            "- 1\n- 2\n",
            r"with the sections flight, bounce, measurement, variations, populations, domain, learned; got \[1, 2\]$",
        ),
        ("", r"a model is a mapping with the sections .*; got None$"),
        ("flights: {}\nbounce: {}", r"unknown section 'flights'; did you mean 'flight'\?$"),
        (
            "flight: {}\nbounce: {}\nradius: 2",
            r"section 'radius'; known ones: flight, bounce, measurement, variations, populations, domain, learned$",
        ),
        ("1: {}", r"unknown section '1'; known ones: "),
        ("flight: {}", r"section 'bounce' is missing; write 'bounce: \{\}' for no effects$"),
        ("flight:\nbounce: {}", r"section 'flight' is missing"),
        ("flight: [drag]\nbounce: {}", r"section 'flight' must map effects to coefficients; got \['drag'\]$"),
        ("flight: {drag: 0.1}\nbounce: {}", r"flight\.drag must map coefficients to numbers; got 0\.1$"),
        ("flight: {drag: {k: high}}\nbounce: {}", r"flight\.drag\.k must be a number; got 'high'"),
        ("flight: {drag: {k: 3e-3}}\nbounce: {}", r"got '3e-3'\. YAML reads 3e-3 as text; write 3\.0e-3$"),
        ("flight: {drag: {k: true}}\nbounce: {}", r"flight\.drag\.k must be a number; got True$"),
        ("flight: {drag: {k: null}}\nbounce: {}", r"flight\.drag\.k must be a number; got None$"),
        ("flight: {drag: {1: 2}}\nbounce: {}", r"effect 'drag' has no coefficient '1'; it has k$"),
        ("flight: {drag: {self: 2}}\nbounce: {}", r"effect 'drag' has no coefficient 'self'; it has k$"),
        ("flight: {drag: {k: .nan}}\nbounce: {}", r"drag\.k must lie in \[0, 2\] 1/m; got nan\. Check its unit\.$"),
        ("flight: {drag: {k: -0.1}}\nbounce: {}", r"drag\.k must lie in \[0, 2\] 1/m; got -0\.1\. Check its unit\.$"),
        (f"flight: {{drag: {{k: 1{'0' * 400}}}}}\nbounce: {{}}", r"a number must have at most 100 digits; got 401"),
        ("flight: {drag: {k: 0.1, k: 0.2}}\nbounce: {}", r"not readable as YAML \('k' stands twice in .* line 1"),
        ("flight: {}\nbounce: {}\nflight: {drag: {}}", r"'flight' stands twice in .* line 1"),
        ("flight: {gale: {}}\nbounce: {}", r"there is no flight effect 'gale'; known ones: gravity, drag"),
        ("flight: {friction: {}}\nbounce: {}", r"there is no flight effect 'friction'"),
        (
            "flight: {}\nbounce: {}\nlearned: {x: 1}",
            r"section 'learned' must be null or the name of a folder beside the file; got \{'x': 1\}",
        ),
        ("flight: {}\nbounce: {}\nlearned: ''", r"section 'learned' must be null or the name of a folder .*; got ''"),
        ("flight: {}\nbounce: {}\nlearned: /dev/null", "the name of a folder beside the file; got '/dev/null'"),
        ("flight: {}\nbounce: {}\nlearned: ../model", r"the name of a folder beside the file; got '\.\./model'"),
        ("flight: {}\nbounce: {}\nlearned: ..", r"the name of a folder beside the file; got '\.\.'"),
        (
            "flight: {}\nbounce: {}\nmeasurement: {x: {}}",
            r"there is no measurement effect 'x'; known ones: time_offset, velocity_lag, frame_tilt",
        ),
        ("flight: {}\nbounce: {}\nmeasurement: [scale]", r"section 'measurement' must map effects to coefficients"),
        ("flight: {scale: {}}\nbounce: {}", r"there is no flight effect 'scale'; known ones: gravity"),
        (
            "flight: {drag_spin: {}}\nbounce: {}",
            r"effects must come with those that they change; got 'drag_spin' without 'drag'\. Add drag to the model or",
        ),
        ("flight: !!python/object/apply:os.getcwd []\nbounce: {}", r"not readable as YAML"),
    ],
)
def test_what_is_wrong_is_said(write, text, message):
    path = write(text)
    with pytest.raises(ValueError, match=message) as error:
        load_model(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


def test_a_learned_part_needs_a_file():
    with pytest.raises(ValueError, match=r"^model: section 'learned' must be null; only a file tells where a learned"):
        model_from_dict({"flight": {}, "bounce": {}, "learned": "folder"})


def test_where_stands_in_front():
    with pytest.raises(ValueError, match=r"^nominal\.yaml: section 'flight' is missing"):
        model_from_dict({}, where="nominal.yaml")
