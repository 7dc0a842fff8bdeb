"""Settings: what is refused, what a track's own sigmas do, what a dataset declares."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ballfg.dynamics import EFFECTS, AnalyticModel, nominal_model
from ballfg.estimation import configure
from ballfg.estimation.configure import dataset_settings, dataset_surfaces
from ballfg.estimation.registry import make_estimator
from ballfg.estimation.segmentation.result import Quality, Segmentation
from ballfg.estimation.settings import MEASURED, Settings, sample_sigmas
from ballfg.estimation.smoother.problem import QUALITY_SIGMA, effective_sigmas
from ballfg.simulation import SimulationConfig, simulate
from ballfg.tracks import Ball, Track, read_dataset
from ballfg.tracks.dataset import dataset_in_memory
from ballfg.tracks.info import DatasetInfo

NONE = np.zeros(0, dtype=np.int64)


@pytest.mark.parametrize(
    "noise", [0.003, (0.001, 0.001), (0.001, 0.0, 0.001), (0.001, np.nan, 0.001), (1.0, 1.0, -1.0)]
)
def test_position_noise_is_three_positive_numbers(noise) -> None:
    with pytest.raises(ValueError, match="position_noise must be three positive numbers in m"):
        Settings(position_noise=noise)


@pytest.mark.parametrize("name", ["spin_prior", "spin_label_noise", "velocity_prior"])
@pytest.mark.parametrize("value", [0.0, -3.0, np.inf, np.nan])
def test_priors_are_positive(name, value) -> None:
    with pytest.raises(ValueError, match=f"{name} must be at least 1e-06, at most 100000; got"):
        Settings(**{name: value})


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, 1e-200, 1e200])
def test_coefficients_have_a_spread(value) -> None:
    """Squares of 1e-200 are zero: the covariance of the coefficients was singular."""
    with pytest.raises(ValueError, match=r"coefficients\['flight.drag.k'\] must be at least 1e-12, at most"):
        Settings(coefficients={"flight.drag.k": value})


def test_what_is_at_the_bounds_is_estimated() -> None:
    """Wider ones ended in errors of the linear algebra."""
    least = {"spin_prior": 1e-6, "velocity_prior": 1e-6, "coefficients": {"flight.drag.k": 1e-12}, "memory_time": 1e-9}
    most = {"spin_prior": 1e5, "velocity_prior": 1e5, "coefficients": {"flight.drag.k": 1e9}, "stamp_jitter": 1.0}
    track = next(iter(simulate(SimulationConfig(tracks=1, seed=4)))).track.until(0.3)
    for bounds in (least, most, {"memory": (1e4, 1e4, 1e4)}):
        chosen = Settings(**bounds)
        for method in ("smoother", "online", "ekf", "sliding-window"):
            found = make_estimator(method, nominal_model(), 0.0, chosen).estimate(track)
            assert np.isfinite(found.states).all(), (method, bounds)
            spread = np.sqrt(np.diagonal(found.covariances, axis1=1, axis2=2))
            correlations = found.covariances / spread[:, :, None] / spread[:, None, :]
            assert (np.linalg.eigvalsh(correlations) > 0.0).all(), (method, bounds)


@pytest.mark.parametrize(("tracks", "looked_for"), [(4, False), (5, True)])
def test_five_tracks_tell_the_noise_where_nobody_states_it(tracks, looked_for, monkeypatch) -> None:
    found = Settings(position_noise=(0.0042,) * 3)
    monkeypatch.setattr(configure, "_fitted", lambda *_: found)
    shots = [shot.track for shot in simulate(SimulationConfig(tracks=tracks, seed=4))]
    data = dataset_in_memory(DatasetInfo("unstated", 0.0, Ball(0.02, 0.0027)), shots)
    assert (configure.fitted_settings(data, nominal_model()) is found) == looked_for


def test_the_noise_is_looked_for_once_for_equal_models(monkeypatch) -> None:
    """Each call of the front door makes a model of its own."""
    calls: list[tuple[object, ...]] = []
    monkeypatch.setattr(configure, "_fitted", lambda *given: calls.append(given) or Settings())
    shots = [shot.track for shot in simulate(SimulationConfig(tracks=5, seed=4))]
    data = dataset_in_memory(DatasetInfo("unstated", 0.0, Ball(0.02, 0.0027)), shots)
    changed = nominal_model()
    with torch.no_grad():
        dict(changed.named_parameters())["flight.drag.k"] += 1e-3
    for model in (nominal_model(), nominal_model(), changed, nominal_model(Ball(0.021, 0.0027))):
        configure.fitted_settings(data, model)
    assert len(calls) == 3


def test_uncertain_takes_the_coefficients_that_vary() -> None:
    settings = Settings.for_measured(nominal_model(), spin_prior=50.0)
    assert settings.coefficients == {
        "flight.drag.k": 0.035,
        "bounce.restitution.e": 0.02,
        "bounce.table_height.offset": 0.004,
    }
    assert settings.process == MEASURED
    assert settings.spin_prior == 50.0
    assert Settings.for_measured(AnalyticModel([EFFECTS["gravity"]()])).coefficients == {}


def test_noise_that_nothing_has_is_raised_to_a_micrometre() -> None:
    own = np.array([[0.0, 1.5e-6, 1e9]])
    least, stated, most = sample_sigmas(Settings(), 1, own)[0].tolist()
    assert 1e-7 < least <= 1e-6
    assert stated == 1.5e-6
    assert 100.0 < most < 1e6


def test_a_track_s_own_sigmas_come_first_and_are_copied() -> None:
    settings = Settings(position_noise=(0.001, 0.002, 0.003))
    np.testing.assert_array_equal(sample_sigmas(settings, 2, None), [[0.001, 0.002, 0.003]] * 2)
    own = np.full((2, 3), 0.01)
    given = sample_sigmas(settings, 2, own)
    np.testing.assert_array_equal(given, own)
    given *= 2.0
    np.testing.assert_array_equal(own, 0.01)


@pytest.mark.parametrize("own", [None, np.full((4, 3), 0.01)], ids=["settings", "own"])
def test_bad_samples_are_widened(own) -> None:
    track = Track(np.arange(4.0), np.zeros((4, 3)), sigmas=own, name="t")
    quality = np.array([Quality.GOOD, Quality.WIDE, Quality.SHIFTED, Quality.OUTLIER], dtype=np.int8)
    segmentation = Segmentation((), NONE, NONE, (), quality)
    base = 0.0015 if own is None else 0.01
    for _ in range(2):  # the second call finds what the first one found
        sigma = effective_sigmas(track, segmentation, Settings())
        np.testing.assert_allclose(sigma[:, 0] / base, [1.0, *QUALITY_SIGMA.values()])


def dataset(folder, info: str, tracks: int = 1):
    rng = np.random.default_rng(0)
    t, rows = 0.01 * np.arange(60), []
    for name in "abcdefghij"[:tracks]:
        path = np.stack((4.0 * t, 0.2 * t, 1.0 + t - 4.905 * t**2), axis=1) + 0.004 * rng.standard_normal((60, 3))
        rows += [f"{name},{s:.9g},{x:.9g},{y:.9g},{z:.9g}" for s, (x, y, z) in zip(t, path, strict=True)]
    (folder / "tracks.csv").write_text("\n".join(["trajectory,t,x,y,z", *rows, ""]), encoding="utf-8")
    (folder / "dataset.yaml").write_text(info, encoding="utf-8")
    return read_dataset(folder)


INFO = """name: test
frame: {up: z, table_height: 0.5}
ball: {radius: 0.02, mass: 0.0027}
rate: 100
"""


def test_a_dataset_s_declared_noise_is_used(tmp_path) -> None:
    found = dataset(tmp_path, INFO + "position_noise: 0.007\nspin_noise: 5\n")
    settings = dataset_settings(found, nominal_model())
    assert settings.position_noise == (0.007,) * 3
    assert settings.spin_label_noise == 5.0
    assert "flight.drag.k" in settings.coefficients


def test_noise_that_a_dataset_does_not_declare_is_read_off_its_tracks(tmp_path) -> None:
    """4 mm were added; what ten tracks tell has a standard deviation of 5 % over seeds: three of them."""
    settings = dataset_settings(dataset(tmp_path, INFO, tracks=10), nominal_model())
    np.testing.assert_allclose(settings.position_noise, 0.004, rtol=0.15)
    assert settings.spin_label_noise == Settings().spin_label_noise


def test_surfaces_of_a_dataset(tmp_path) -> None:
    surfaces = dataset_surfaces(dataset(tmp_path, INFO))
    assert surfaces.table_height == 0.5
    assert surfaces.floor_height == pytest.approx(0.5 - 0.76)
    assert surfaces.extent is None
