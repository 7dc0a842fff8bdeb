"""A kept model gives the numbers of the model it stands for, without torch, and becomes it for anything else."""

import copy
import pickle
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ballfg.dynamics import AnalyticModel, Surfaces, load_model, nominal_model, save_model
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.compiled import kept_model
from ballfg.dynamics.compiled.build import read_note
from ballfg.dynamics.compiled.kept_model import (
    KeptModel,
    augmented,
    carried,
    content_of,
    keep,
    ready,
    ready_file,
    whole,
)
from ballfg.dynamics.compiled.motion import Moving, functions_of
from ballfg.dynamics.compiled.places import numbers_of
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.model_file import model_from_dict, model_to_dict
from ballfg.dynamics.nominal import keep_nominal, ready_nominal
from ballfg.dynamics.population import SpinGroup, SpinPopulation
from ballfg.dynamics.variation import Variation
from ballfg.estimation import Settings, Smoother
from ballfg.tracks import TABLE_TENNIS, Track
from ballfg.tracks.info import DatasetInfo
from ballfg.tracks.noise import TrackNoise
from ballfg.tracks.writing import write_dataset
from tests.interpreter import fresh

STATES = np.array(
    [[0.0, 0.1, 0.4, 5.0, 0.3, -1.0, 20.0, 150.0, 5.0], [1.0, 0.0, 0.2, 3.0, -1.0, -2.0, 0.0, -80.0, 9.0]]
)
TWICE = """
import hashlib, sys, numpy as np
{first}
import ballfg as bf
t = np.arange(120) / 200.0
z = 0.02 + 0.9 * np.abs(0.98 - 4.905 * t**2)
places = np.stack([3 * t - 1, 0.3 + 0 * t, z], 1) + 0.0015 * np.random.default_rng(0).normal(size=(120, 3))
found = [bf.estimate((t[:n], places[:n]), model={model}) for n in (40, 120)]
stream = bf.Online(bf.Ball(0.02, 0.0027), bf.Surfaces(0.0))
states = [stream.push(a, b) for a, b in zip(t, places)]
found += [states[-1].state, states[-1].covariance]
ahead = found[0].last.predict(1.0)
found += [ahead.states, ahead.covariances]
found += [event.covariance for event in (ahead.next_contact, ahead.apex, ahead.crossing(z=0.1, after=1))]
found.append(np.array([ahead.event(asked).probability for asked in ("apex", "next-contact", "x=1.0")]))
print(hashlib.sha256(b"".join(np.ascontiguousarray(getattr(x, "states", x)).tobytes() for x in found)).hexdigest())
print("torch" in sys.modules)
from ballfg.dynamics.model import BallModel
print(isinstance(found[0].last.world.model, BallModel))
"""
COMMAND = """
import atexit, sys
atexit.register(lambda: print("torch:", "torch" in sys.modules))
sys.argv = ["ballfg", *{words}]
from ballfg.cli.entry import ballfg
ballfg()
"""


def made_of(model: AnalyticModel, about: str) -> KeptModel:
    keep(about, model)
    facts = read_note(kept_model._key(about))
    assert facts is not None
    return KeptModel(facts, lambda: model)


@pytest.fixture
def usual() -> AnalyticModel:
    model = nominal_model()
    model.noise = TrackNoise(position=(0.001, 0.002, 0.003))
    model.variations = {"flight.drag.k": Variation("ball", {"new": 0.11, "old": 0.15})}
    group = SpinGroup((1.0, 50.0, 0.0), (5.0, 20.0, 5.0), 12)
    model.spins = SpinPopulation("launcher", {"a": group})
    return model


def test_it_says_what_the_model_says(usual: AnalyticModel) -> None:
    kept = made_of(usual, "a usual ball")
    for name in ("radius", "inertia_factor", "noise", "spins", "variations", "domain", "learned_from"):
        assert getattr(kept, name) == getattr(usual, name)
    assert kept.declared_coefficients() == usual.declared_coefficients()
    assert numbers_of(kept).values() == numbers_of(usual).values()
    assert content_of(kept) == model_to_dict(usual)
    assert content_of(kept.for_group("ball", "new")) == model_to_dict(usual.for_group("ball", "new"))
    assert kept.states_position_noise
    assert kept.measures_plainly
    assert Settings.for_measured(kept) == Settings.for_measured(usual)
    assert isinstance(kept, AnalyticModel)
    assert "whole" not in vars(kept)


def test_its_motion_is_that_of_the_model(usual: AnalyticModel) -> None:
    names = ("flight.drag.k", "bounce.restitution.e")
    kept, right = made_of(usual, "moved"), AugmentedModel(usual, names)
    start = np.column_stack((STATES, np.full((2, 2), (0.12, 0.9))))
    for own, other, at in ((kept, usual, STATES), (augmented(kept, names), right, start)):
        found = []
        for model in (own, other):
            functions = functions_of(model)
            assert functions is not None
            moving = Moving(model, functions, at, at.shape[1])
            found.append((*moving.travel(np.full(2, 0.2), np.zeros((2, 1))), *moving.gaps(0.0), moving.rates()))
        for one, same in zip(*found, strict=True):
            np.testing.assert_array_equal(one, same)
    assert carried(augmented(kept, names)) == (kept, names)
    assert augmented(kept, ()) is kept


def test_tracks_and_groups_have_their_coefficients(usual: AnalyticModel) -> None:
    kept = made_of(usual, "with variations")
    track = Track(np.arange(5) / 100, np.zeros((5, 3)), labels={"ball": "old"})
    for found in (kept.for_track(track), pickle.loads(pickle.dumps(replaced(kept.for_group("ball", "old"))))):
        assert numbers_of(found).value("flight.drag.k") == 0.15
        assert whole(found).get_parameter("flight.drag.k").item() == 0.15
    assert kept.for_track(replace(track, labels={})) is kept
    assert numbers_of(kept).value("flight.drag.k") == numbers_of(usual).value("flight.drag.k")


def replaced(kept: KeptModel) -> KeptModel:
    """The same, made by a function that can be pickled."""
    vars(kept)["_make"] = nominal_model
    return kept


def test_once_the_model_is_made_its_numbers_count(usual: AnalyticModel) -> None:
    kept = made_of(usual, "changed later")
    with pytest.raises(AttributeError, match="nothing"):
        kept.nothing  # noqa: B018
    kept.flight["drag"].k.data.fill_(0.2)
    assert numbers_of(kept).value("flight.drag.k") == 0.2
    with pytest.raises(ValueError, match="not a scalar parameter"):
        augmented(kept, ("flight.drag.nothing",))


def test_estimates_are_the_same(usual: AnalyticModel) -> None:
    kept, times = made_of(usual, "estimated"), np.arange(60) / 200
    places = np.stack([3 * times, 0 * times, 0.02 + np.abs(0.3 - 3.0 * times)], axis=1)
    noisy = places + 0.001 * np.random.default_rng(1).normal(size=places.shape)
    found = [Smoother(model, Surfaces(0.0)).estimate(Track(times, noisy)) for model in (kept, usual)]
    np.testing.assert_array_equal(found[0].states, found[1].states)
    np.testing.assert_array_equal(found[0].covariances, found[1].covariances)


@pytest.mark.parametrize("change", ["measurement", "own effect"])
def test_other_models_are_not_kept(change: str, monkeypatch: pytest.MonkeyPatch) -> None:
    model = nominal_model()
    if change == "measurement":
        model = with_measurement(model)
    else:
        drag = type(model.flight["drag"])
        monkeypatch.setattr(drag, "acceleration", lambda self, flight: None)
    keep(f"no note: {change}", model)
    assert read_note(kept_model._key(f"no note: {change}")) is None


def with_measurement(model: AnalyticModel) -> AnalyticModel:
    return model_from_dict({**model_to_dict(model), "measurement": {"time_offset": {"y": 0.002}}})


def test_a_file_that_changes_is_another_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, asked = tmp_path / "model.yaml", list[str]()
    monkeypatch.setattr(kept_model, "sys", SimpleNamespace(modules={}))  # a process without torch
    monkeypatch.setattr(kept_model, "read_note", lambda about: asked.append(about))
    monkeypatch.setattr(kept_model, "write_note", lambda about, note: asked.append(about))
    save_model(nominal_model(), path)
    first = ready_file(path)
    assert type(first) is AnalyticModel
    assert asked[0] == asked[1]
    path.write_text(path.read_text().replace("restitution:\n    e: ", "restitution:\n    e: 0.8 #"))
    ready_file(path)
    assert asked[2] != asked[0]

    def rewritten() -> BallModel:
        path.write_text("another model")
        return nominal_model()

    ready(path.read_text, rewritten)
    assert len(asked) == 5  # read, and not written: the file changed while it was read


@pytest.mark.parametrize("of_file", [False, True])
def test_estimates_of_a_fresh_process_need_no_torch(of_file: bool, tmp_path: Path) -> None:
    path = tmp_path / "model.yaml"
    save_model(nominal_model(), path)
    loaded = load_model(path, inertia_factor=ready_nominal(TABLE_TENNIS).inertia_factor)
    keep_nominal(TABLE_TENNIS)
    keep(kept_model.about_file(path, None, loaded.inertia_factor), loaded)
    model = repr(str(path)) if of_file else "None"
    said = [fresh(TWICE.format(first=first, model=model), check=True).stdout.split() for first in ("import torch", "")]
    assert said[0][0] == said[1][0]
    assert (said[0][1:], said[1][1:]) == (["True", "True"], ["False", "True"])


@pytest.mark.parametrize("count", [1, 6])
def test_commands_on_a_dataset_need_no_torch(count: int, tmp_path: Path) -> None:
    """Of one track, which does not show its noise, and of some that do; the model beside them is the usual one."""
    times = np.arange(50) / 100.0
    path = np.stack([4.0 * times, 0.1 + 0.0 * times, 0.3 + 1.5 * times - 4.7 * times**2], axis=1)
    rng = np.random.default_rng(0)
    tracks = [Track(times, path + 0.002 * rng.normal(size=path.shape), name=f"{k}") for k in range(count)]
    write_dataset(tmp_path / "shots", DatasetInfo("shots", None, TABLE_TENNIS), tracks)
    save_model(nominal_model(), tmp_path / "shots" / "model.yaml")
    keep_nominal(TABLE_TENNIS)
    for words in (
        ["estimate", "shots", "--out", "states.csv"],
        ["predict", "shots", "--observe", "0.3", "--out", "ahead.csv"],
        ["live", "--replay", "shots", "--speed", "0", "--plane", "x=1.5", "--out", "stream.jsonl"],
        ["show", "shots", "--out", "shots.html"],
    ):
        said = fresh(COMMAND.format(words=words), cwd=tmp_path, check=True)
        assert (tmp_path / words[-1]).is_file(), said.stderr
        assert said.stdout.endswith("torch: False\n"), words[0]


def test_what_is_changed_is_changed_in_copies_and_in_the_file(tmp_path: Path) -> None:
    """Attributes, and a coefficient in place: both make the model, which then counts."""
    kept = made_of(nominal_model(), "a ball that is changed")
    kept.noise = TrackNoise(position=(0.001, 0.002, 0.003))
    with torch.no_grad():
        kept.get_parameter("flight.drag.k").fill_(0.2)
    again = pickle.loads(pickle.dumps(kept))
    save_model(kept, tmp_path / "model.yaml")
    for found in (kept, again, copy.copy(kept), copy.deepcopy(kept), load_model(tmp_path / "model.yaml")):
        assert found.noise == kept.noise
        assert float(found.get_parameter("flight.drag.k").detach()) == pytest.approx(0.2)
    assert content_of(kept) == model_to_dict(again)
    copy.copy(kept).noise = None
    assert kept.noise is not None
