"""From a fit to a model that others can use."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ballfg.diagnosis.fit.fit import values_of
from ballfg.diagnosis.fit.holdout import EvaluationTrack
from ballfg.diagnosis.fit.problem import launch_axes
from ballfg.diagnosis.search.evaluation import (
    calibrated_model,
    for_next_shot,
    has_population,
    noise_about,
    without_population,
)
from ballfg.dynamics import load_model, nominal_model, save_model
from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.simulation import MeasurementNoise, SimulationConfig, simulate
from ballfg.simulation.synthetic import dataset_info
from ballfg.tracks import read_dataset, write_dataset
from ballfg.tracks.noise import TrackNoise

EMBEDDING = SpinEmbedding(("group",), {"group": ("one",)})


@pytest.fixture(scope="module")
def unlabelled(make_ball, make_launches, make_shots, make_fit):
    data = make_shots(make_ball(), make_launches(6, 61), 61, labelled=False, duration=0.5, rate=50.0)
    return make_fit(make_ball(), data.stretches)


def test_coefficients_are_those_of_the_fit(calm_fit):
    model = calibrated_model(calm_fit, EMBEDDING)
    values = {n: float(p) for n, p in model.named_parameters() if n in calm_fit.unknowns.values}
    assert values == calm_fit.unknowns.values
    assert float(calm_fit.problem.model.flight["drag"].k) == 0.12  # a copy
    assert not any(p.requires_grad for p in model.parameters())


def test_labelled_tracks_need_no_launcher(calm_fit):
    trained = calibrated_model(calm_fit, EMBEDDING).trained
    assert trained.launcher is None
    assert trained.spin_noise == calm_fit.noise.label
    assert trained.position_scale == pytest.approx(np.sqrt((calm_fit.noise.position**2).mean()))


def test_groups_have_the_mean_and_the_scatter_of_their_spins(unlabelled):
    model = calibrated_model(unlabelled, EMBEDDING)
    assert model.trained.launcher is None
    group = model.spins.groups["one"]
    np.testing.assert_allclose(group.mean, unlabelled.unknowns.launcher[0])
    np.testing.assert_allclose(group.sigma, unlabelled.noise.spin)
    assert group.tracks == 6


def test_settings_that_are_numbers_tell_the_spins_of_the_fit(unlabelled):
    trained = calibrated_model(unlabelled, SpinEmbedding(("topspin",), {})).trained
    assert trained.spin_noise == pytest.approx(np.sqrt((unlabelled.noise.spin**2).mean()))
    starts, settings = unlabelled.unknowns.starts, unlabelled.problem.stretches.settings
    mean = (launch_axes(starts) @ (settings @ unlabelled.unknowns.launcher)[..., None])[..., 0]
    told = trained.launcher.spin(torch.from_numpy(settings), torch.from_numpy(starts[:, 3:6]))
    np.testing.assert_allclose(told.detach().numpy(), mean, atol=1e-9)
    local = trained.launcher.local(torch.ones(1, dtype=torch.float64)).numpy()
    np.testing.assert_allclose(local, unlabelled.unknowns.launcher[0], atol=1e-9)


def test_standard_deviations_are_those_of_the_whole_problem(calm_fit):
    """Of the dense information matrix with every first state in it."""
    system = calm_fit.linearised
    n, m, q = system.by_common.shape
    dense = np.zeros((n * m, 9 * n + q))
    for i in range(n):
        dense[i * m : (i + 1) * m, 9 * i : 9 * i + 9] = system.by_start[i]
        dense[i * m : (i + 1) * m, 9 * n :] = system.by_common[i]
    information = dense.T @ dense
    free = len(calm_fit.problem.free)
    precision = np.concatenate((calm_fit.problem.precisions, np.repeat(calm_fit.problem.launcher_precision, 3)))
    information[9 * n :, 9 * n :] += np.diag(precision)
    sigma = np.sqrt(np.diagonal(np.linalg.inv(information)))[9 * n : 9 * n + free]
    found = values_of(calm_fit, calm_fit.problem.free, {"flight.drag.k": 0.12})
    np.testing.assert_allclose([v.sigma for v in found.values()], sigma, rtol=1e-6)
    assert found["flight.drag.k"].declared == 0.12
    assert found["flight.drag.k"].unit == "1/m"
    assert found["bounce.restitution.e"].declared is None


def test_the_model_goes_through_a_file(unlabelled, tmp_path):
    model = calibrated_model(unlabelled, EMBEDDING)
    save_model(model, tmp_path / "model.yaml")
    again = load_model(tmp_path / "model.yaml", radius=model.radius)
    for name, value in model.named_parameters():
        assert dict(again.named_parameters())[name].item() == pytest.approx(value.item(), rel=1e-9)
    assert again.trained.position_scale == pytest.approx(model.trained.position_scale, rel=1e-9)
    assert again.spins == model.spins


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Eight shots of an exact simulation with errors of 2 mm, and the tracks as they are evaluated."""
    config = SimulationConfig(tracks=8, rate=60.0, seed=6, noise=MeasurementNoise(position=0.002))
    folder = tmp_path_factory.mktemp("recording") / "shots"
    write_dataset(folder, dataset_info(config), (s.track for s in simulate(config)), "csv")
    dataset = read_dataset(folder)
    return dataset, [EvaluationTrack(track, np.zeros(0)) for track in dataset]


def test_noise_about_a_model_is_that_of_the_tracks(recording):
    dataset, parts = recording
    noise = noise_about(nominal_model(), parts, dataset)
    np.testing.assert_allclose(noise.position, 0.002, rtol=0.2)
    assert noise.memory is None
    assert noise.stamp_jitter is None
    assert noise.coefficients["flight.drag.k"] < 0.01  # the simulated balls are alike


def test_a_known_tracker_stays(recording):
    dataset, parts = recording
    tracker = TrackNoise(memory=(0.001, 0.001, 0.002), memory_time=0.03, stamp_jitter=0.0002)
    noise = noise_about(nominal_model(), parts, dataset, tracker)
    assert (noise.memory, noise.memory_time, noise.stamp_jitter) == ((0.001, 0.001, 0.002), 0.03, 0.0002)
    assert max(noise.position) < 0.002  # a part of the errors is the tracker's


def test_tracks_that_are_too_short_tell_no_noise(recording):
    dataset, parts = recording
    short = [EvaluationTrack(part.track.until(float(part.track.times[3])), part.bounces) for part in parts]
    assert noise_about(nominal_model(), short, dataset) is None


@pytest.mark.parametrize("wrong", [False, True])
def test_a_further_shot_scatters_as_the_planted_spins(make_ball, make_launches, make_shots, make_fit, wrong):
    """By 60 rad/s about across and 5 about the others; also beside a gust, which is motion and no scatter of spins."""
    starts = make_launches(24, 14, spin=0.0)
    local = np.random.default_rng(14).standard_normal((24, 3)) * (5.0, 60.0, 5.0)
    starts[:, 6:] = torch.from_numpy((launch_axes(starts.numpy()) @ local[..., None])[..., 0])
    shots = make_shots(make_ball(), starts, 14, labelled=False, noise=0.001).stretches
    if wrong:
        kick = 0.01 * np.random.default_rng(5).standard_normal((24, 1, 3)) * (np.arange(42)[:, None] / 42) ** 2
        shots = replace(shots, positions=shots.positions + torch.from_numpy(kick))
    fit = make_fit(make_ball(), shots)
    forward, across, up = for_next_shot(fit).noise.spin
    assert across == pytest.approx(60.0 * np.sqrt(25.0 / 24.0), rel=0.35)  # 24 draws tell a scatter to 15 %
    assert max(forward, up) < 0.4 * across


def test_shots_that_agree_leave_the_doubt_about_their_mean(make_ball, make_launches, make_shots, make_fit):
    starts = make_launches(6, 21, spin=0.0)
    fit = make_fit(make_ball(), make_shots(make_ball(), starts, 21, labelled=False).stretches)
    total = fit.gram.sum(axis=0)[:-1, :-1] + np.diag(fit.problem.common_precision)
    doubt = np.sqrt(np.diagonal(np.linalg.inv(total))[-3:])
    assert (for_next_shot(fit).noise.spin > 0.5 * doubt).all()


def test_labelled_spins_have_no_population(calm_fit):
    assert for_next_shot(calm_fit) is calm_fit
    assert not has_population(calibrated_model(calm_fit, EMBEDDING))


def test_without_its_population_a_model_is_the_same_ball(unlabelled):
    model = calibrated_model(unlabelled, EMBEDDING)
    bare = without_population(model)
    assert has_population(model)
    assert not has_population(bare)
    assert bare.spins is None
    assert bare.trained.launcher is None
    assert bare.trained.position_scale == model.trained.position_scale
    assert {n: float(p) for n, p in bare.named_parameters()} == {n: float(p) for n, p in model.named_parameters()}
