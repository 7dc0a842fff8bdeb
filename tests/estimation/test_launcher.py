"""A launcher's settings in the estimators, and what a trained model says of noise and launcher."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ballfg import simulation as simulate_module
from ballfg.dynamics import Surfaces, nominal_model, rollout
from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.dynamics.trained import Trained
from ballfg.estimation import ExtendedKalmanFilter, Online, Settings, SlidingWindow, Smoother
from ballfg.estimation.configure import dataset_settings, launcher_of
from ballfg.estimation.launcher import FIRST_SAMPLES, Launcher
from ballfg.estimation.settings import MEASURED
from ballfg.factors.launcher import LauncherSpinFactors
from ballfg.factors.loss import Loss
from ballfg.factors.prior import PriorFactors, SpinLabelFactors
from ballfg.simulation.launcher import SimulatedLauncher
from ballfg.tracks import Track, read_dataset
from ballfg.tracks.track import SPIN_LABELS

TABLE = Surfaces(0.0, -0.76)
LEVELS = {"topspin": 2.0, "sidespin": -1.0, "group": "left"}
LOCAL = np.array([10.0, 120.0, -40.0])
"""rad/s about forward, across and up: 2 x (0, 50, 0) - (0, 0, 40) + (10, 20, 0) for the left gun."""


@pytest.fixture
def embedding() -> SpinEmbedding:
    rows = [[0.0, 50.0, 0.0], [0.0, 0.0, 40.0], [10.0, 20.0, 0.0], [-10.0, 0.0, 5.0]]
    initial = torch.tensor(rows, dtype=torch.float64)
    return SpinEmbedding(("topspin", "sidespin", "group"), {"group": ("left", "right")}, initial)


@pytest.fixture
def launcher(embedding) -> Launcher:
    return Launcher(embedding, 12.0)


def world(velocity: np.ndarray) -> np.ndarray:
    forward = np.array([velocity[0], velocity[1], 0.0]) / np.hypot(velocity[0], velocity[1])
    across = np.cross([0.0, 0.0, 1.0], forward)
    return LOCAL[0] * forward + LOCAL[1] * across + LOCAL[2] * np.array([0.0, 0.0, 1.0])


VELOCITY = np.array([4.0, -2.0, 1.0])


def shot(labels=LEVELS, samples: int = 30, noise: float = 0.001) -> Track:
    times = 1.0 + 0.01 * np.arange(samples)
    start = torch.from_numpy(np.concatenate(([0.0, 0.0, 0.35], VELOCITY, world(VELOCITY)))[None])
    with torch.no_grad():
        truth = rollout(nominal_model(), start, torch.from_numpy(times - 1.0), TABLE)[0].numpy()
    positions = truth[:, :3] + noise * np.random.default_rng(0).standard_normal((samples, 3))
    return Track(times, positions, labels=labels, name="shot")


def test_a_label_from_settings_and_first_samples(launcher) -> None:
    """Along the mean direction of flight over the first samples."""
    track = shot(noise=0.0)
    spin = launcher.label(track).spin
    np.testing.assert_allclose(spin, world(VELOCITY), atol=1.0)  # air bends the flight in 0.1 s
    np.testing.assert_allclose(np.linalg.norm(spin), np.linalg.norm(LOCAL), rtol=2e-4)
    assert launcher.label(track).sigma == launcher.sigma
    positions = track.positions.copy()
    positions[FIRST_SAMPLES:] += 1.0
    later = replace(track, positions=positions)
    np.testing.assert_array_equal(launcher.label(later).spin, spin)


def test_tracks_that_tell_nothing_have_no_label(launcher) -> None:
    own = shot({**LEVELS, "spin_x": 1.0, "spin_y": 2.0, "spin_z": 3.0})
    unknown, missing, single = (
        shot({**LEVELS, "group": "new"}),
        shot({"topspin": 2.0, "group": "left"}),
        shot(samples=1),
    )
    for track in (own, unknown, missing, single):
        assert launcher.label(track) is None
    for track in (own, unknown, missing):
        assert launcher.settings(track) is None
    np.testing.assert_array_equal(launcher.settings(single), [2.0, -1.0, 1.0, 0.0])
    told = Settings(launcher=launcher, spin_label_noise=33.0)
    assert told.spin_label(single) is None
    label = told.spin_label(own)
    np.testing.assert_array_equal(label.spin, [1.0, 2.0, 3.0])
    assert label.sigma == 33.0


def test_defaults_hold_where_a_track_says_nothing(embedding) -> None:
    levels = {"topspin": 2.0, "sidespin": -1.0}
    launcher = Launcher(embedding, 12.0, {"group": "right"})
    np.testing.assert_array_equal(launcher.settings(shot(levels)), [2.0, -1.0, 0.0, 1.0])
    np.testing.assert_array_equal(launcher.settings(shot(LEVELS)), [2.0, -1.0, 1.0, 0.0])
    assert Launcher(embedding, 12.0).settings(shot(levels)) is None


@pytest.mark.parametrize("sigma", [0.0, -1.0, np.nan, np.inf])
def test_sigma_is_positive(sigma, embedding) -> None:
    with pytest.raises(ValueError, match="sigma must be finite and above 0; got"):
        Launcher(embedding, sigma)


def settings_with(launcher: Launcher | None, **changes) -> Settings:
    plain = {"position_noise": (0.001,) * 3, "spin_prior": 150.0, "spin_label_noise": 12.0, "label_loss": Loss()}
    return Settings(launcher=launcher, **(plain | changes))


def kinds_of(track: Track, settings: Settings) -> list[object]:
    smoother = Smoother(nominal_model(), TABLE, settings)
    events = smoother.segment(track)
    solution = smoother.settle(smoother.problem(track, events))
    return list(smoother.problem(track, events, np.full((len(track), 3), 0.001)).graph(solution.events).batches)


def test_the_smoother_s_graph_has_one_word_on_the_first_spin(launcher) -> None:
    """The launcher's factor, or the label's, or the prior's; always beside a wide prior."""
    own = {"spin_x": 1.0, "spin_y": 2.0, "spin_z": 3.0}
    for labels, expected in ((LEVELS, LauncherSpinFactors), ({**LEVELS, **own}, SpinLabelFactors), ({}, PriorFactors)):
        about = [kind for kind in kinds_of(shot(labels), settings_with(launcher)) if kind.variables.tolist() == [[0]]]
        wide = [kind for kind in about if type(kind) is PriorFactors and kind.dim == 9]
        rest = [kind for kind in about if kind not in wide]
        assert len(wide) == 1
        assert [type(kind) for kind in rest] == [expected]
    (factor,) = [kind for kind in kinds_of(shot(), settings_with(launcher)) if isinstance(kind, LauncherSpinFactors)]
    np.testing.assert_array_equal(factor.sigma, [[12.0] * 3])


def test_the_smoother_finds_the_launch_direction_with_the_spin(launcher) -> None:
    """As with a label along the true direction; far better than without."""
    track = shot()
    spin = dict(zip(SPIN_LABELS, world(VELOCITY).tolist(), strict=True))
    told = Smoother(nominal_model(), TABLE, settings_with(launcher)).estimate(track)
    label = Smoother(nominal_model(), TABLE, settings_with(None)).estimate(replace(track, labels=spin))
    silent = Smoother(nominal_model(), TABLE, settings_with(None)).estimate(track)
    truth = world(VELOCITY)
    errors = [np.linalg.norm(e.states[0, 6:] - truth) for e in (told, label, silent)]
    print(errors)  # shown by -s
    assert np.abs((told.states - label.states) / label.sigmas).max() < 0.2
    assert errors[0] < 0.5 * errors[2]


@pytest.mark.parametrize(
    ("make", "apart"),
    [(ExtendedKalmanFilter, 1e-6), (SlidingWindow, 1e-6), (Online, 0.2)],
    ids=["ekf", "window", "online"],
)
def test_other_estimators_take_it_as_a_label(make, apart, launcher) -> None:
    """As well known as the launcher says, not as a spin label would be; `apart` in standard deviations.

    The online estimator ends with a smoother, which finds the direction of the launch together with the spin.
    """
    track = shot(samples=20)
    told = make(nominal_model(), TABLE, settings_with(launcher, spin_label_noise=33.0)).estimate(track)
    spin = dict(zip(SPIN_LABELS, launcher.label(track).spin.tolist(), strict=True))
    labelled = make(nominal_model(), TABLE, settings_with(None)).estimate(replace(track, labels=spin))
    assert np.abs((told.states - labelled.states) / labelled.sigmas).max() < apart
    np.testing.assert_allclose(told.sigmas, labelled.sigmas, rtol=max(apart, 1e-9) / 10)


# --- what a trained model says


INFO = """name: guns
frame: {up: z, table_height: 0.5}
ball: {radius: 0.02, mass: 0.0027}
rate: 100
position_noise: 0.002
"""


def dataset(folder):
    rows = [f"a,{t:.9g},{x:.9g},{y:.9g},{z:.9g}" for t, (x, y, z) in zip(shot().times, shot().positions, strict=True)]
    (folder / "tracks.csv").write_text("\n".join(["trajectory,t,x,y,z", *rows, ""]), encoding="utf-8")
    (folder / "dataset.yaml").write_text(INFO, encoding="utf-8")
    return read_dataset(folder)


def test_settings_of_a_trained_model(tmp_path, embedding) -> None:
    """Its noise, its launcher, itself without uncertain coefficients."""
    model, data = nominal_model(), dataset(tmp_path)
    assert dataset_settings(data, model).coefficients
    assert launcher_of(data.info, model) is None
    model.trained = Trained({"acceleration": 0.31, "contact_spin": 4.0}, 1.5, embedding, 22.0)
    settings = dataset_settings(data, model)
    assert settings.coefficients == {}
    assert settings.process == replace(MEASURED, acceleration=0.31, contact_spin=4.0)
    assert (settings.position_noise, settings.position_scale) == ((0.002,) * 3, 1.5)
    assert settings.spin_label_noise == Settings().spin_label_noise
    assert (settings.launcher.embedding, settings.launcher.sigma) == (embedding, 22.0)
    assert settings.launcher.defaults == {"group": "guns"}
    for half in (Trained(launcher=embedding), Trained(spin_noise=22.0)):
        model.trained = half
        assert dataset_settings(data, model).launcher is None
    assert dataset_settings(data, model).spin_label_noise == 22.0


def test_topspin_turns_the_top_of_the_ball_forward() -> None:
    levels = Launcher.of_levels(50.0, 40.0, 4.0)
    for direction in ((1.0, 0.0), (0.0, -1.0), (0.6, 0.8)):
        velocity = torch.tensor([5.0 * direction[0], 5.0 * direction[1], 1.0], dtype=torch.float64)
        settings = torch.tensor([2.0, 0.0], dtype=torch.float64)
        spin = levels.embedding.spin(settings, velocity).detach().numpy()
        top = np.cross(spin, [0.0, 0.0, 0.02])  # velocity of the ball's top relative to its centre
        np.testing.assert_allclose(top, 0.02 * 100.0 * np.array([*direction, 0.0]), atol=1e-3)


def test_levels_give_the_spin_of_the_simulated_launcher() -> None:
    simulated = SimulatedLauncher()
    levels = Launcher.of_levels(simulated.topspin_scale, simulated.sidespin_scale, 4.0)
    for made in simulate_module.simulate(simulate_module.SimulationConfig(tracks=12, seed=2, spin_labels=False)):
        labelled = levels.labelled(made.track)
        assert labelled.spin_label is not None
        # what is left is the launcher's shot-to-shot spread, 3 rad/s an axis, and that of the direction: four of them
        np.testing.assert_allclose(labelled.spin_label, made.true_states[0, 6:], atol=12.0)


def test_measured_labels_win_and_missing_settings_change_nothing() -> None:
    levels = Launcher.of_levels(50.0, 40.0, 4.0)
    track = Track(np.arange(5) * 0.01, np.arange(15.0).reshape(5, 3) * 0.05, name="a")
    assert levels.labelled(track) is track
    labels = {"spin_x": 1.0, "spin_y": 2.0, "spin_z": 3.0, "topspin": 1.0, "sidespin": 0.0}
    measured = Track(track.times, track.positions, labels=labels, name="a")
    assert levels.labelled(measured) is measured
