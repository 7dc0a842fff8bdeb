"""From a config to a trainee, its steps of coefficients, and from a trained one to a model for estimators."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from ballfg.dynamics import load_model
from ballfg.dynamics.analytic import AnalyticModel
from ballfg.dynamics.networks.learned import LearnedModel
from ballfg.estimation import dataset_settings
from ballfg.learning.config.training import TrainConfig
from ballfg.learning.end_to_end.end_to_end import EndToEnd
from ballfg.learning.gradient.implicit import GaussNewtonGradient, ImplicitGradient, UnrolledGradient
from ballfg.learning.run.loop import make_optimizer
from ballfg.learning.run.training import build
from ballfg.learning.sequence.trainee import SequenceTrainee
from ballfg.learning.training_data import FIRST_SPIN, FIRST_SPIN_NOISE, categories_of
from ballfg.tracks import Track, read_dataset, write_dataset

OBSERVE = {"samples": 25}
SMALL = {"width_flight": 4, "width_contact": 4, "depth": 1, "pretrain": 2}


def config(data: Path | list[Path], **fields) -> TrainConfig:
    folders = [str(folder) for folder in (data if isinstance(data, list) else [data])]
    return TrainConfig.model_validate({"data": folders, "observe": OBSERVE} | fields)


def launched(**fields) -> dict:
    return {"launcher": {"labels": ["topspin", "sidespin", "group"]}, "loss": {"likelihood": 1.0}} | fields


def test_coefficients_of_the_analytic_model(few_tracks) -> None:
    trainee, train, validation = build(config(few_tracks, kind="a-tune", split={"by": "alternate"}))
    assert isinstance(trainee, EndToEnd)
    assert isinstance(trainee.learnables.model, AnalyticModel)
    assert (list(train), list(validation)) == ([0, 2, 4], [1, 3, 5])
    assert trainee.augment
    assert isinstance(trainee.method, ImplicitGradient)
    assert trainee.learnables.embedding is None
    assert not trainee.learnables.noise.learned
    shot = trainee.shots[0]
    assert shot.observed == 25
    assert shot.settings.coefficients == {}  # the model is taken to be exact, or nothing could be learned
    assert shot.settings.position_noise == (0.0015,) * 3
    loss = trainee.loss([0, 2], 0)
    assert loss.tracks == 2
    loss.total.backward()
    assert trainee.learnables.model.flight.drag.k.grad is not None


@pytest.mark.parametrize("kind", ["mlp", "mlp+gs", "skip+gs", "mnn+gs"])
def test_networks(kind, few_tracks, capsys) -> None:
    trainee, *_ = build(config(few_tracks, kind=kind, architecture=SMALL))
    model = trainee.learnables.model
    assert isinstance(model, LearnedModel)
    assert (model.architecture.kind, model.architecture.width_flight, model.base) == (kind, 4, None)
    assert trainee.augment == (kind == "mlp")
    assert "networks fitted to the analytic model: " in capsys.readouterr().out
    again = build(config(few_tracks, kind=kind, architecture=SMALL))[0]
    for a, b in zip(model.parameters(), again.learnables.model.parameters(), strict=True):
        assert torch.equal(a, b)


def test_a_residual_network_starts_as_what_it_corrects(few_tracks, capsys) -> None:
    architecture = {"width_flight": 4, "width_contact": 4, "depth": 1, "residual": True}
    trainee, *_ = build(config(few_tracks, architecture=architecture))
    assert "fitted" not in capsys.readouterr().out
    state = torch.tensor([[0.0, 0.0, 1.0, 4.0, 1.0, 2.0, 10.0, 60.0, 20.0]], dtype=torch.float64)
    model = trainee.learnables.model
    torch.testing.assert_close(model.rates(state)[0], model.base.rates(state)[0])
    vacuum, *_ = build(config(few_tracks, architecture=SMALL | {"pretrain": 0}))
    expected = torch.tensor([[0.0, 0.0, -9.80665]], dtype=torch.float64)
    torch.testing.assert_close(vacuum.learnables.model.rates(state)[0], expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(
    ("name", "method"),
    [("implicit", ImplicitGradient), ("gauss-newton", GaussNewtonGradient), ("unrolled", UnrolledGradient)],
)
def test_the_gradient_s_way(name, method, few_tracks) -> None:
    assert type(build(config(few_tracks, kind="a-tune", gradient=name))[0].method) is method


@pytest.mark.parametrize("kind", ["a-tune", "lstm"])
def test_a_track_is_in_one_dataset(kind, few_tracks, tmp_path) -> None:
    """In two, whatever their names, it would train and validate."""
    copied, renamed = tmp_path / "copy", tmp_path / "renamed"
    shutil.copytree(few_tracks, copied)
    write_dataset(renamed, replace(read_dataset(few_tracks).info, name="other"), reversed(list(read_dataset(copied))))
    for other, track in ((few_tracks, "000"), (copied, "000"), (renamed, "005")):
        message = rf"each track once; got track '{track}' of {other} also as '{track}' of {few_tracks}\. Give each"
        with pytest.raises(ValueError, match=message):
            build(config([few_tracks, other], kind=kind))


def test_sequence_models_see_the_same_shots(few_tracks) -> None:
    trainee, train, _ = build(config(few_tracks, kind="lstm"))
    assert isinstance(trainee, SequenceTrainee)
    dynamics, same, _ = build(config(few_tracks, kind="a-tune"))
    assert list(train) == list(same)
    assert len(dynamics.shots) == 6


def test_noise_of_the_config(few_tracks) -> None:
    noise = {"position_scale": 2.0, "acceleration": 0.7, "contact_tangential": 0.0, "spin_label": 9.0}
    trainee, *_ = build(config(few_tracks, kind="a-tune", noise=noise, loss={"likelihood": 0.5}))
    settings, scales = trainee.shots[0].settings, trainee.learnables.noise
    assert scales.position_scale() == pytest.approx(2.0)
    assert settings.spin_label_noise == 9.0
    assert (settings.process.acceleration, settings.process.contact_tangential) == (0.7, 0.0)
    assert scales.learned
    assert scales.start == settings.process
    assert "contact_tangential" not in scales.names


def test_launcher_settings(no_spin_labels) -> None:
    trainee, *_ = build(config(no_spin_labels, kind="a-tune", split={"by": "none"}, **launched()))
    embedding = trainee.learnables.embedding
    group = read_dataset(no_spin_labels).info.name
    names = set(embedding.names)
    assert {"topspin", "sidespin"} < names
    assert all(name.startswith("group=") for name in names - {"topspin", "sidespin"})
    first = dict(zip(embedding.names, (100.0 * embedding.weight.detach().T).tolist(), strict=True))
    for name, spin in first.items():
        assert spin == pytest.approx(list(FIRST_SPIN.get(name, (0.0, 0.0, 0.0))))
    settings = trainee.shots[0].settings
    assert settings.launcher.embedding is embedding  # one of all shots, and the one that is learned
    assert settings.launcher.sigma == FIRST_SPIN_NOISE
    assert settings.launcher.defaults == {"group": group}
    assert all(settings.launcher.settings(shot.track) is not None for shot in trainee.shots)
    loss = trainee.loss([0, 1], 0)
    loss.total.backward()
    assert float(embedding.weight.grad.abs().max()) > 0.0
    assert float(trainee.learnables.noise.spin.grad.abs()) > 0.0


def test_a_label_that_no_track_has(few_tracks) -> None:
    with pytest.raises(ValueError, match=r"launcher\.labels must be labels of the tracks; no track has 'tilt'"):
        build(config(few_tracks, kind="a-tune", launcher={"labels": ["topspin", "tilt"]}))


def test_categories_are_the_texts() -> None:
    times, positions = np.arange(2.0), np.zeros((2, 3))
    labels = ({"gun": "b", "level": 2.0}, {"gun": "a", "level": 3.0}, {"gun": "b"})
    tracks = [Track(times, positions, labels=one, name=str(k)) for k, one in enumerate(labels)]
    assert categories_of(["level", "gun"], tracks) == {"gun": ("a", "b")}


def test_a_trained_model_goes_out_and_into_an_estimator(no_spin_labels, tmp_path) -> None:
    """Model, noise and launcher as they were learned, read back by those who estimate with `--model`."""
    trainee, *_ = build(config(no_spin_labels, kind="mnn+gs", architecture=SMALL, **launched()))
    learnables = trainee.learnables
    with torch.no_grad():
        learnables.noise.process += 0.1 * torch.arange(1.0, 1 + len(learnables.noise.names), dtype=torch.float64)
        learnables.noise.position.fill_(0.5)
        learnables.noise.spin.fill_(-1.0)
        learnables.embedding.weight += 0.25
    path = trainee.export(tmp_path)
    model, dataset = (
        load_model(path, radius=read_dataset(no_spin_labels).info.ball.radius),
        read_dataset(no_spin_labels),
    )
    settings = dataset_settings(dataset, model)
    expected = learnables.noise.settings(trainee.shots[0].settings)
    assert settings.coefficients == {}
    for name, value in vars(expected.process).items():
        assert getattr(settings.process, name) == pytest.approx(value, rel=1e-12), name
    assert settings.position_noise == expected.position_noise
    assert settings.position_scale == pytest.approx(expected.position_scale, rel=1e-12)
    assert settings.launcher.sigma == pytest.approx(FIRST_SPIN_NOISE * np.exp(-1.0), rel=1e-12)
    assert settings.launcher.defaults == {"group": dataset.info.name}
    track = next(iter(dataset))
    label = settings.spin_label(track).spin
    np.testing.assert_allclose(label, expected.spin_label(track).spin, rtol=1e-10)
    state = torch.tensor([[0.0, 0.0, 1.0, 4.0, 1.0, -2.0, 10.0, 60.0, 20.0]], dtype=torch.float64)
    torch.testing.assert_close(model.rates(state)[0], learnables.model.rates(state)[0], rtol=1e-12, atol=1e-12)


def test_without_launcher_nothing_is_said_of_spins(few_tracks) -> None:
    trainee, *_ = build(config(few_tracks, kind="a-tune"))
    trained = trainee.trained_model().trained
    assert (trained.launcher, trained.spin_noise, trained.position_scale) == (None, None, 1.0)
    assert dict(trained.process_noise) == vars(trainee.shots[0].settings.process)


def test_datasets_together(few_tracks, no_spin_labels, capsys) -> None:
    """Each with its own settings; the split counts in each by itself."""
    trainee, train, validation = build(config([few_tracks, no_spin_labels], kind="a-tune", split={"by": "alternate"}))
    assert (list(train), list(validation)) == ([0, 2, 4, 6, 8], [1, 3, 5, 7])
    assert len({id(shot.settings) for shot in trainee.shots}) == 2
    assert trainee.judge([0, 7]).tracks == 2
    note = "note: 'simulated table-tennis' names several datasets: they count as one room and group\n"
    assert note in capsys.readouterr().err


def test_balls_of_one_kind(few_tracks, tmp_path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    for file in few_tracks.iterdir():
        if file.is_file():
            (other / file.name).write_bytes(file.read_bytes())
    info = yaml.safe_load((other / "dataset.yaml").read_text(encoding="utf-8"))
    info["ball"]["radius"] = 0.033
    (other / "dataset.yaml").write_text(yaml.safe_dump(info), encoding="utf-8")
    with pytest.raises(ValueError, match=r"data must be of one kind of ball; got radii \[0.02, 0.033\] m"):
        build(config([few_tracks, other], kind="a-tune"))


def test_tracks_that_are_too_short_are_told(few_tracks, capsys) -> None:
    with pytest.raises(ValueError, match="data must hold a track to train on; none of 6 can be used"):
        build(config(few_tracks, kind="a-tune", observe={"samples": 2000}))
    assert "note: 6 tracks of " in capsys.readouterr().err


def test_a_learned_model_is_no_start(no_spin_labels, tmp_path) -> None:
    trainee, *_ = build(config(no_spin_labels, architecture=SMALL))
    path = trainee.export(tmp_path)
    with pytest.raises(ValueError, match=r"model must be analytic; .* has a learned part"):
        build(config(no_spin_labels, kind="a-tune", model=str(path)))


def after_a_step(data: Path, **optimizer: float) -> dict[str, float]:
    """By how much each coefficient moves in the first step."""
    given = {"data": [str(data)], "split": {"by": "none"}, "observe": {"samples": 25}, "kind": "a-tune"}
    config = TrainConfig.model_validate(given | {"optimizer": {"learning_rate": 0.01} | optimizer})
    trainee, *_ = build(config)
    model = trainee.learnables.model
    before = {name: float(p.detach()) for name, p in model.named_parameters()}
    adam = make_optimizer(trainee, config.optimizer)
    for group in adam.param_groups:
        group["lr"] = group["scale"] * config.optimizer.learning_rate
    trainee.loss([0, 1, 2], 0).total.backward()
    adam.step()
    return {name: abs(float(p.detach()) - before[name]) for name, p in model.named_parameters()}


def test_adam_moves_each_by_the_same_share_of_its_standard_deviation(no_spin_labels: Path) -> None:
    moved = after_a_step(no_spin_labels, coefficient_step=10.0)
    assert moved["flight.drag.k"] == pytest.approx(0.01 * 10.0 * 0.035, rel=1e-3)
    assert moved["flight.magnus.k"] == pytest.approx(0.01 * 10.0 * 0.0008, rel=1e-3)
    assert moved["flight.gravity.g"] == 0.0  # as good as known
