"""The spins of a group of shots as the prior of a track's first spin, in every estimator."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import ballfg as bf
from ballfg.cli.inputs import model_alone
from ballfg.dynamics import Surfaces, nominal_model, save_model
from ballfg.dynamics.motion.paths import paths
from ballfg.dynamics.population import SpinGroup, SpinPopulation, launch_axes
from ballfg.estimation import Online, Settings, Smoother, dataset_settings, predict_tracks
from ballfg.estimation.noise.linear_tracks import linearise
from ballfg.estimation.registry import make_estimator
from ballfg.factors.loss import Loss
from ballfg.state import SPIN, VELOCITY
from ballfg.tracks import TABLE_TENNIS, Track, read_dataset, write_dataset
from ballfg.tracks.info import DatasetInfo
from ballfg.tracks.noise import TrackNoise
from ballfg.tracks.track import SPIN_LABELS

MODEL, TABLE = nominal_model(), Surfaces.table_tennis(0.0)
SPINS = SpinPopulation(
    "player",
    {
        "ann": SpinGroup((5.0, 150.0, -20.0), (4.0, 12.0, 8.0), 10),
        "bob": SpinGroup((0.0, -100.0, 10.0), (6.0, 9.0, 15.0), 10),
    },
)
START = np.array([0.0, 0.0, 0.5, -3.0, 4.0, 1.0])
"""First position and velocity, in no axis' direction."""
NEAR = 0.02
"""As the direction of a launch from ten samples."""


def shot(group: str, samples: int = 40, **labels: str) -> Track:
    """A track of a ball with the mean spin of a group, sampled at 100 Hz with 1 mm of noise."""
    times = np.arange(samples) * 0.01
    spin = np.array(SPINS.groups[group].mean) @ launch_axes(START[3:])
    with torch.no_grad():
        path = paths(MODEL, torch.from_numpy(np.append(START, spin))[None], torch.from_numpy(times), TABLE)
    noise = np.random.default_rng(6).normal(0.0, 0.001, (samples, 3))
    return Track(times, path[0, :, :3].numpy() + noise, labels=labels)


def settings(**changes: object) -> Settings:
    return Settings.for_measured(MODEL, **({"spins": SPINS, "position_noise": (0.001,) * 3} | changes))


@pytest.mark.parametrize("method", ["smoother", "online", "ekf", "sliding-window"])
@pytest.mark.parametrize(("labels", "group"), [({"player": "ann"}, None), ({}, "ann"), ({"player": "ann"}, "bob")])
def test_a_short_track_has_the_spin_of_its_group(method: str, labels: dict[str, str], group: str | None) -> None:
    track = shot("ann", 12, **labels)
    estimate = make_estimator(method, MODEL, TABLE, settings(group=group)).estimate(track)
    axes = launch_axes(START[3:])
    spin, covariance = axes @ estimate.states[0, SPIN], axes @ estimate.covariances[0][SPIN, SPIN] @ axes.T
    known = SPINS.groups["ann"]
    np.testing.assert_allclose(spin, known.mean, atol=0.3 * min(known.sigma) + NEAR * 150.0)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), known.sigma, rtol=0.1)


def test_a_group_like_the_usual_prior_changes_nothing() -> None:
    usual = SpinPopulation("player", {"all": SpinGroup((0.0,) * 3, (60.0,) * 3, 1)})
    track = shot("ann")
    one, other = (Smoother(MODEL, TABLE, settings(spins=spins)).estimate(track) for spins in (None, usual))
    np.testing.assert_allclose(other.states, one.states, atol=1e-6)
    np.testing.assert_allclose(other.covariances, one.covariances, rtol=1e-6, atol=1e-9)


def test_an_unknown_group_has_the_mixture_as_prior() -> None:
    track = shot("ann", 4)
    vague = settings(spin_loss=Loss("squared"), position_noise=(0.02,) * 3)
    estimate = Smoother(MODEL, TABLE, vague).estimate(track)
    mean, covariance = SPINS.spin(None)
    axes = launch_axes(START[3:])
    np.testing.assert_allclose(axes @ estimate.states[0, SPIN], mean, atol=5.0)
    np.testing.assert_allclose(axes @ estimate.covariances[0][SPIN, SPIN] @ axes.T, covariance, rtol=0.05, atol=150.0)


@pytest.mark.parametrize("method", ["smoother", "online", "ekf", "sliding-window"])
def test_another_group_than_the_only_known_one_may_spin_otherwise(method: str) -> None:
    """Of its own spin it is less than three sigma off, where the known group's spins would be twenty."""
    alone, track = SpinPopulation("player", {"ann": SPINS.groups["ann"]}), shot("bob", 12, player="bob")
    found = make_estimator(method, MODEL, TABLE, settings(spins=alone)).estimate(track)
    axes = launch_axes(START[3:])
    off = axes @ found.states[0, SPIN] - SPINS.groups["bob"].mean
    covariance = axes @ found.covariances[0][SPIN, SPIN] @ axes.T
    assert off @ np.linalg.solve(covariance, off) < 9.0


@pytest.mark.parametrize(
    ("name", "labels", "groups", "known", "group"),
    [
        ("ann", {}, "ann", True, "ann"),  # the dataset that trained: its tracks without a label are its own group
        ("ann", {"player": "bob"}, "ann bob", True, "ann"),
        ("room", {}, "ann bob", False, None),  # another room, whose spins may be others
        ("room", {}, "ann", False, None),
        ("room", {"player": "ann"}, "ann", True, None),
    ],
)
def test_tracks_without_a_label_are_of_their_datasets_own_group(
    name: str, labels: dict[str, str], groups: str, known: bool, group: str | None, tmp_path: Path
) -> None:
    model = nominal_model()
    model.spins = SpinPopulation("player", {one: SPINS.groups[one] for one in groups.split()})
    info = DatasetInfo(name=name, table_height=0.0, ball=TABLE_TENNIS, position_noise=0.001)
    write_dataset(tmp_path / "shots", info, [replace(shot("ann", **labels), name="a")])
    found = dataset_settings(read_dataset(tmp_path / "shots"), model)
    assert (found.spins, found.group) == (model.spins if known else model.spins.with_unseen(found.spin_prior), group)


def test_a_spin_label_takes_precedence() -> None:
    spin = np.array(SPINS.groups["ann"].mean) @ launch_axes(START[3:])
    label = dict(zip(SPIN_LABELS, spin.tolist(), strict=True))
    track = replace(shot("ann", 12), labels={"player": "bob", **label})
    estimate = Smoother(MODEL, TABLE, settings()).estimate(track)
    np.testing.assert_allclose(estimate.states[0, SPIN], spin, atol=10.0)


def test_the_group_makes_a_prediction_better() -> None:
    track = shot("bob")
    errors = []
    for own in (settings(group="bob"), settings(spins=None)):
        (found,) = predict_tracks(Smoother(MODEL, TABLE, own), [track], 1, 0.15)
        errors.append(np.linalg.norm(found.positions - found.measured, axis=1).max())
    assert errors[0] < 0.7 * errors[1]


def test_a_stream_has_the_spin_of_its_group_turned_by_any_angle_before_its_direction_shows() -> None:
    online, known = Online(MODEL, TABLE, settings(group="ann")), SPINS.groups["ann"]
    state = online.push(0.0, START[:3])
    across = np.sqrt((known.mean[0] ** 2 + known.mean[1] ** 2 + known.sigma[0] ** 2 + known.sigma[1] ** 2) / 2.0)
    np.testing.assert_allclose(state.state[SPIN], [0.0, 0.0, known.mean[2]], atol=1e-3)
    np.testing.assert_allclose(state.sigmas[SPIN], [across, across, known.sigma[2]], rtol=0.01)
    slow = [online.push(0.001 * k, START[:3] + 0.001 * k * START[3:]) for k in range(1, 4)]  # at most 15 mm
    assert all(one.sigmas[SPIN][0] > 0.99 * across for one in slow)


def test_a_stream_has_the_spin_of_its_group_once_its_direction_shows() -> None:
    track = shot("ann", 14)
    online = Online(MODEL, TABLE, settings(group="ann"))
    states = [online.push(t, x) for t, x in zip(track.times, track.positions, strict=True)]
    axes, known = launch_axes(START[3:]), SPINS.groups["ann"]
    for state in states[1:9]:
        covariance = axes @ state.covariance[SPIN, SPIN] @ axes.T
        away = axes @ state.state[SPIN] - known.mean
        assert np.abs(away).max() < 12.0
        assert away @ np.linalg.solve(covariance, away) < 12.0
    for state in states[9:]:
        np.testing.assert_allclose(axes @ state.state[SPIN], known.mean, atol=5.0)
    whole = Online(MODEL, TABLE, settings(group="ann")).estimate(track)
    np.testing.assert_allclose(states[-1].state[SPIN], whole.states[-1, SPIN], atol=1.0)
    np.testing.assert_allclose(states[-1].state[VELOCITY], whole.states[-1, VELOCITY], atol=0.01)


def test_a_linearised_track_has_its_groups_prior() -> None:
    track = shot("ann")
    linear = linearise(Smoother(MODEL, TABLE, settings(group="ann")), [track])
    assert linear is not None
    assert not linear.labelled.any()
    np.testing.assert_allclose(np.sort(linear.group_sigmas[0]), np.sort(SPINS.groups["ann"].sigma))
    # whatever the axes, the first spin moves the next state in the same way
    plain = linearise(Smoother(MODEL, TABLE, settings(spins=None)), [track])
    assert plain is not None
    one, other = (t.transitions[0, 0, :9, SPIN] for t in (linear, plain))
    np.testing.assert_allclose(one @ one.T, other @ other.T, rtol=0.05, atol=1e-7)


def test_a_group_without_populations_or_an_unknown_name_is_refused() -> None:
    with pytest.raises(ValueError, match=r"group must be None for a model without groups; got 'ann'.*groups: LABEL"):
        settings(spins=None, group="ann")
    with pytest.raises(ValueError, match=r"in Python write Settings.for_measured\(model, group=...\) with it"):
        Settings(group="ann")
    with pytest.raises(ValueError, match="group must be one of the model's, ann, bob; got 'eve'"):
        settings(group="eve")


def test_python_takes_the_groups_of_a_model_as_the_commands_do() -> None:
    """Without a dataset too: settings by hand, an estimator by itself, the front door."""
    model, noise = nominal_model(), TrackNoise(position=(0.001,) * 3, memory_time=0.03, acceleration=0.02)
    model.spins, model.noise = SPINS, noise
    found = Settings.for_measured(model, group="ann", memory_time=0.05)
    assert (found.spins, found.group, found.position_noise) == (SPINS, "ann", noise.position)
    assert (found.process.acceleration, found.memory_time) == (0.02, 0.05)
    assert Settings.for_measured(model, spins=None) == Settings.for_measured(MODEL)
    track, known = shot("ann", 12, player="ann"), SPINS.groups["ann"]
    estimates = [bf.estimate(track, model=model), Smoother(model, 0.0).estimate(track)]
    estimates += [Online(model, 0.0, settings=found).estimate(shot("ann", 12))]
    for estimate in estimates:
        spin = launch_axes(START[3:]) @ estimate.states[0, SPIN]
        np.testing.assert_allclose(spin, known.mean, atol=0.3 * min(known.sigma) + NEAR * 150.0)


def test_python_takes_the_noise_of_a_model_as_the_commands_do(tmp_path: Path) -> None:
    """`ballfg live --model` has the noise of the file; so has a robot that loads it, with groups or without."""
    model = nominal_model()
    model.noise = TrackNoise(position=(0.004,) * 3, memory_time=0.03, acceleration=0.02)
    save_model(model, tmp_path / "model.yaml")
    loaded, command = model_alone(tmp_path / "model.yaml", None)
    assert Settings.for_measured(loaded) == command
    assert command.position_noise == (0.004,) * 3
    assert Settings.for_measured(loaded, spins=None) == Settings.for_measured(MODEL)
    times = np.arange(20) / 100
    track = bf.Track(times, np.column_stack((3.0 * times, 0.0 * times, 0.0 * times + 1.0)))
    own, usual = (bf.estimate(track, model=one).covariances[-1, 1, 1] for one in (loaded, MODEL))
    assert own > 4.0 * usual
