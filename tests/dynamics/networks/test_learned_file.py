"""Learned parts of model files: bit for bit out and in, whole or not at all, and what is wrong is said."""

from __future__ import annotations

import math
import os
import shutil

import numpy as np
import pytest
import safetensors.torch
import torch
import yaml

from ballfg.dynamics import AnalyticModel, Architecture, BallModel, build, load_model, nominal_model, save_model
from ballfg.dynamics.model_file import model_from_dict, model_to_dict
from ballfg.dynamics.networks.learned import LearnedModel
from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.dynamics.population import SpinGroup, SpinPopulation
from ballfg.dynamics.trained import Trained
from ballfg.dynamics.variation import Variation
from ballfg.tracks import Track
from ballfg.tracks.noise import TrackNoise

KINDS = ("mlp", "mlp+gs", "skip+gs", "mnn+gs")


@pytest.fixture
def trained():
    embedding = SpinEmbedding(("topspin", "group"), {"group": ("flat", "böck")})
    torch.nn.init.normal_(embedding.weight, generator=torch.Generator().manual_seed(1))
    noise = {"acceleration": 0.1 / 3, "contact_velocity": 0.07}
    return Trained(noise, 4.0 / 3, embedding, 7.0 / 3)


@pytest.fixture
def learned(trained):
    model = small()
    model.trained = trained
    return model


def small(kind="mnn+gs", base=None, seed=3):
    architecture = Architecture.of(kind, width_flight=5, width_contact=4, residual=base is not None, spin_rate=True)
    model = build(architecture, radius=0.02, base=base, seed=seed)
    for parameter in model.parameters():
        with torch.no_grad():
            parameter += torch.randn(parameter.shape, generator=torch.Generator().manual_seed(9)).double() / 300
    return model


def same(one, other):
    assert type(one) is type(other)
    for (name, value), (name_too, value_too) in zip(one.named_parameters(), other.named_parameters(), strict=True):
        assert name == name_too
        assert value.dtype == value_too.dtype
        assert torch.equal(value, value_too), name


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("residual", [False, True])
def test_round_trip(kind, residual, every_effect, tmp_path):
    model = small(kind, every_effect if residual else None)
    save_model(model, tmp_path / "m.yaml")
    again = load_model(tmp_path / "m.yaml", radius=0.02)
    same(model, again)
    assert again.architecture == model.architecture
    assert again.trained is None
    content = yaml.safe_load((tmp_path / "m.yaml").read_text())
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(["m.yaml", content["learned"]])
    assert content["flight"] == (model_to_dict(every_effect)["flight"] if residual else {})


def test_noise_and_spins_of_the_corrected_model_are_read_and_written_again(tmp_path):
    base = nominal_model()
    base.noise = TrackNoise(acceleration=0.1, coefficients={"flight.drag.k": 0.01})
    base.spins = SpinPopulation("group", {"top": SpinGroup((0.0, 60.0, 0.0), (3.0, 10.0, 3.0), 7)})
    save_model(small(KINDS[1], base), tmp_path / "m.yaml")
    first = load_model(tmp_path / "m.yaml", radius=0.02)
    assert first.noise == TrackNoise(acceleration=0.1, coefficients={"base.flight.drag.k": 0.01})
    assert first.spins == base.spins
    save_model(first, tmp_path / "n.yaml")
    again = load_model(tmp_path / "n.yaml", radius=0.02)
    assert (again.noise, again.spins) == (first.noise, first.spins)


@pytest.mark.parametrize("residual", [False, True])
def test_networks_know_the_ball_that_they_learned_from(residual, every_effect, tmp_path):
    """Its radius is that of a model whose caller states none; another ball is refused, a like one is not."""
    architecture = Architecture.of("mnn+gs", width_flight=5, width_contact=4, residual=residual)
    base = model_from_dict(model_to_dict(every_effect), radius=0.033) if residual else None
    save_model(build(architecture, radius=0.033, base=base), tmp_path / "m.yaml")
    assert load_model(tmp_path / "m.yaml").radius == 0.033
    like = load_model(tmp_path / "m.yaml", radius=0.035)
    assert (like.radius, like.learned_from) == (0.035, None)
    for other in (0.02, 0.11):
        if residual:  # which keeps the law that it corrects
            model = load_model(tmp_path / "m.yaml", radius=other)
            assert (model.radius, model.learned_from) == (other, 0.033)
            save_model(model, tmp_path / "again.yaml")
            assert load_model(tmp_path / "again.yaml").radius == 0.033
            continue
        message = rf"config.yaml: the ball must have the radius 0.033 m that its networks .*; got {other} m, .*Train on"
        with pytest.raises(ValueError, match=message):
            load_model(tmp_path / "m.yaml", radius=other)
    with pytest.raises(ValueError, match=r"radius must be 0.001 to 1 m; got 0\."):
        load_model(tmp_path / "m.yaml", radius=0.0)


def test_a_file_of_earlier_versions_takes_any_ball(saved, tmp_path):
    path, folder = saved
    content = yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))
    assert content.pop("radius") == 0.02
    (folder / "config.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    folder.rename(folder.with_name("earlier"))  # a name without a digest
    path.write_text(path.read_text().replace(folder.name, "earlier"))
    assert load_model(path, radius=0.11).radius == 0.11
    assert load_model(path).radius == 0.02
    nominal = nominal_model()
    nominal.trained = Trained({}, 1.0, None, None)
    save_model(nominal, tmp_path / "tuned.yaml")
    (tuned,) = tmp_path.glob("tuned.learned-*/config.yaml")
    assert "radius" not in tuned.read_text()  # laws hold for every size
    assert load_model(tmp_path / "tuned.yaml", radius=0.11).radius == 0.11


def test_values_of_groups_stay_those_of_the_model_it_corrects(every_effect, tmp_path):
    model = small(KINDS[0], every_effect)
    model.variations = {"base.bounce.restitution.e": Variation("group", {"old": 0.8})}
    save_model(model, tmp_path / "m.yaml")
    again = load_model(tmp_path / "m.yaml", radius=0.02)
    assert again.variations == model.variations
    track = Track(np.array([0.0, 0.1]), np.zeros((2, 3)), labels={"group": "old"})
    assert float(again.for_track(track).base.bounce["restitution"].e.detach()) == 0.8


def test_round_trip_of_what_was_learned_beside(learned, tmp_path):
    save_model(learned, tmp_path / "m.yaml")
    again = load_model(tmp_path / "m.yaml").trained
    before = learned.trained
    assert (again.process_noise, again.position_scale, again.spin_noise) == (
        before.process_noise,
        before.position_scale,
        before.spin_noise,
    )
    assert (again.launcher.labels, again.launcher.categories) == (before.launcher.labels, before.launcher.categories)
    same(again.launcher, before.launcher)


def test_a_tuned_analytic_model(trained, tmp_path):
    model = nominal_model()
    save_model(model, tmp_path / "m.yaml")
    assert [p.name for p in tmp_path.iterdir()] == ["m.yaml"]
    model.trained = trained
    save_model(model, tmp_path / "m.yaml")
    again = load_model(tmp_path / "m.yaml")
    assert isinstance(again, AnalyticModel)
    same(model, again)
    assert again.trained.process_noise == trained.process_noise
    model.trained = Trained({"acceleration": 0.2})
    save_model(model, tmp_path / "m.yaml")
    assert load_model(tmp_path / "m.yaml").trained == Trained({"acceleration": 0.2})
    assert len(list(tmp_path.iterdir())) == 3  # the weights of both


def test_radius_and_inertia_are_the_balls(tmp_path):
    save_model(small("mnn+gs", nominal_model()), tmp_path / "m.yaml")
    again = load_model(tmp_path / "m.yaml", radius=0.033, inertia_factor=0.5)
    assert (again.radius, again.contact.radius, again.base.radius, again.inertia_factor) == (0.033, 0.033, 0.033, 0.5)


def test_saving_again_replaces(tmp_path):
    for seed in (1, 2, 2):
        model = small(seed=seed)
        save_model(model, tmp_path / "m.yaml")
        save_model(small(seed=7), tmp_path / "other.yaml")
        same(model, load_model(tmp_path / "m.yaml"))
    assert len(list(tmp_path.iterdir())) == 5  # two files, and weights of three contents


@pytest.mark.parametrize("name", ["model[1].yaml", "*.yaml", "model?.yaml", "model1.yml", "[!x]odel1.yaml"])
def test_saving_one_model_leaves_the_weights_of_all_others(name, tmp_path):
    first = small(seed=1)
    save_model(first, tmp_path / "model1.yaml")
    for other in (small(seed=2), nominal_model()):
        save_model(other, tmp_path / name)
        same(first, load_model(tmp_path / "model1.yaml"))


def test_a_copy_keeps_its_weights_when_the_file_is_saved_again(tmp_path):
    first = small(seed=1)
    save_model(first, tmp_path / "model.yaml")
    shutil.copy(tmp_path / "model.yaml", tmp_path / "best.yaml")
    save_model(small(seed=2), tmp_path / "model.yaml")
    save_model(nominal_model(), tmp_path / "model.yaml")
    same(first, load_model(tmp_path / "best.yaml"))


def test_saving_again_mends_weights_that_were_damaged(saved, learned):
    path, folder = saved
    (folder / "weights.safetensors").write_bytes(b"damaged")
    (folder / "notes.txt").write_text("mine")
    save_model(learned, path)
    same(learned, load_model(path))
    assert (folder / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("step", ["mkdir", "rename", "replace"])
def test_a_crash_leaves_the_earlier_model(step, tmp_path, monkeypatch):
    first, path = small(seed=1), tmp_path / "m.yaml"
    save_model(first, path)

    def crash(*_, **__):
        raise OSError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr(*({"mkdir": ("pathlib.Path.mkdir", crash)}.get(step) or (os, step, crash)))
        with pytest.raises(OSError, match="disk full"):
            save_model(small(seed=2), path)
    same(first, load_model(path))
    save_model(small(seed=2), path)
    same(small(seed=2), load_model(path))


def test_only_models_that_a_file_can_hold(tmp_path):
    class Still(BallModel):
        def rates(self, state):
            return torch.zeros_like(state[..., 3:6]), None

        def after_bounce(self, state):
            return state

    for model in (Still(0.02), small("mlp", Still(0.02))):
        with pytest.raises(
            TypeError, match=r"^model must be analytic, learned, or learned on an analytic one; got Still"
        ):
            save_model(model, tmp_path / "m.yaml")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def saved(learned, tmp_path):
    """A saved model's file and folder."""
    save_model(learned, tmp_path / "m.yaml")
    return tmp_path / "m.yaml", next(p for p in tmp_path.iterdir() if p.is_dir())


def test_missing_parts(saved):
    path, folder = saved
    for name in ("weights.safetensors", "config.yaml"):
        (folder / name).unlink()
        with pytest.raises(FileNotFoundError, match=rf"{name} does not exist; a learned part is a folder with config"):
            load_model(path)
    shutil.rmtree(folder)
    with pytest.raises(FileNotFoundError, match="does not exist; a learned part is a folder"):
        load_model(path)


@pytest.mark.parametrize("name", ["config.yaml", "weights.safetensors"])
def test_a_flipped_bit_is_found(saved, name):
    path, folder = saved
    content = bytearray((folder / name).read_bytes())
    place = content.index(b"0.") + 2 if name == "config.yaml" else len(content) - 8  # lowest digits of a number
    content[place] ^= 1
    (folder / name).write_bytes(content)
    with pytest.raises(ValueError, match=r"must be as they were saved, .* [0-9a-f]{12} .* Copy the folder again"):
        load_model(path)


def change_config(folder, keys, value):
    content = yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))
    at = content
    for key in keys[:-1]:
        at = at[key]
    at[keys[-1]] = value
    (folder / "config.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")


@pytest.mark.parametrize(
    ("keys", "value", "message"),
    [
        (("architecture", "kind"), "rnn", r"config\.yaml: architecture\.kind: Input should be 'mlp', .*; got 'rnn'\.$"),
        (("architecture", "depth"), 0, r"architecture\.depth: Input should be greater than or equal to 1; got 0\.$"),
        (("architecture", "depth"), 2.5, r"architecture\.depth: Input should be a valid integer; got 2\.5\.$"),
        (("architecture", "color"), 1, r"architecture\.color: Extra inputs are not permitted; got 1\.$"),
        (("trained", "spin_noise"), -1.0, r"config\.yaml: spin_noise must be positive and finite; got -1\.0\.$"),
        (("trained", "process_noise"), {"spin": -1.0}, r"process_noise\['spin'\] must be finite and not negative; got"),
        (("trained", "position_scale"), [1.0], r"trained\.position_scale.*got"),
        (("trained", "spin_noise"), math.nan, r"trained\.spin_noise: Input should be a finite number; got nan\.$"),
        (("trained", "launcher", "labels"), [], r"config\.yaml: labels must be names that differ"),
        (
            ("architecture", "width_flight"),
            6,
            r"tensor 'model\.flight.*' must be torch\.float64 of shape .*do not belong",
        ),
        (("architecture", "kind"), "skip+gs", r"tensor 'model\.contact\.network\.hidden\.0\.bias' is missing; config"),
        (("architecture",), None, r"tensor 'model\..*' is not of this model; config\.yaml and weights"),
    ],
)
def test_a_config_that_is_wrong(saved, keys, value, message):
    path, folder = saved
    change_config(folder, keys, value)
    with pytest.raises(ValueError, match=message) as error:
        load_model(path)
    assert str(error.value).startswith(str(folder))
    assert "\n" not in str(error.value)


def test_a_config_that_is_no_yaml(saved):
    path, folder = saved
    (folder / "config.yaml").write_text("architecture: [", encoding="utf-8")
    with pytest.raises(ValueError, match=r"config\.yaml: not readable as YAML"):
        load_model(path)
    (folder / "config.yaml").write_text("architecture: !!python/object/apply:os.getcwd []", encoding="utf-8")
    with pytest.raises(ValueError, match=r"config\.yaml: not readable as YAML"):
        load_model(path)
    (folder / "config.yaml").write_text("- 1", encoding="utf-8")
    with pytest.raises(ValueError, match=r"config\.yaml: content: Input should be a valid dictionary"):
        load_model(path)


def test_weights_that_are_wrong(saved):
    path, folder = saved
    weights = folder / "weights.safetensors"
    tensors = safetensors.torch.load_file(weights)
    name = "model.flight.network.first.weight"
    for change, message in (
        (
            {name: tensors[name].float()},
            r"must be torch\.float64 of shape \(5, 3\); got torch\.float32 of shape \(5, 3\)",
        ),
        ({name: tensors[name].T.contiguous()}, r"got torch\.float64 of shape \(3, 5\)\."),
        ({name: tensors[name] * math.nan}, r"must be finite; it holds NaN or infinity\. Train again\.$"),
        ({"more": torch.zeros(1)}, r"tensor 'more' is not of this model"),
    ):
        safetensors.torch.save_file({**tensors, **change}, weights)
        with pytest.raises(ValueError, match=message):
            load_model(path)
    weights.write_bytes(b"not safe")
    with pytest.raises(ValueError, match=r"weights\.safetensors must be a whole safetensors file"):
        load_model(path)


def test_effects_beside_a_model_that_stands_alone(saved):
    path, _ = saved
    content = yaml.safe_load(path.read_text()) | {"flight": {"gravity": {}}}
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(ValueError, match=r"must stand alone; the model file declares gravity\. Leave its sections"):
        load_model(path)


def test_moving_file_and_folder_together(saved, learned, tmp_path):
    path, folder = saved
    (tmp_path / "elsewhere").mkdir()
    for part in (path, folder):
        shutil.move(part, tmp_path / "elsewhere" / part.name)
    again = load_model(tmp_path / "elsewhere" / path.name)
    assert isinstance(again, LearnedModel)
    same(again, learned)
