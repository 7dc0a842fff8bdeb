"""A planted drag law comes back inside its band and predicts other flights better; without one nothing is learned."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from scipy import stats

from ballfg.dynamics import AnalyticModel, Surfaces, load_model, nominal_model
from ballfg.dynamics.effects.flight import Drag, DragSpeed, Gravity, Magnus
from ballfg.dynamics.effects.generic import DOUBTS, FUNCTIONS, WEIGHTS, AirCorrection, correction_terms
from ballfg.dynamics.model_file import model_to_dict
from ballfg.dynamics.motion.paths import paths
from ballfg.estimation import dataset_settings
from ballfg.learning.calibration import picture, run
from ballfg.learning.calibration.auto import (
    CALIBRATED,
    CANDIDATES,
    CORRECTED,
    GROUPED,
    NOMINAL,
    NOTICED,
    PER_TRACK,
    choose_candidate,
    compared,
    config_of,
)
from ballfg.learning.calibration.calibrate import calibrate, pose_correction
from ballfg.learning.calibration.coefficients import Chosen
from ballfg.learning.calibration.correction import (
    ALL,
    SCALE,
    Correction,
    learned,
    places,
    set_doubts,
    spans,
    with_correction,
)
from ballfg.learning.calibration.groups import WIDTHS, _widest
from ballfg.learning.calibration.picture import draw
from ballfg.learning.calibration.population import Evidence
from ballfg.learning.calibration.predicting import finished
from ballfg.learning.calibration.problem import Problem, Step, population_model, population_settings, pose, score
from ballfg.learning.calibration.report import compare
from ballfg.learning.calibration.run import run_calibration
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.config.config_file import checked_config
from ballfg.learning.evaluation import TrackScore, log_density, summary
from ballfg.progress import unwatched
from ballfg.simulation import SimulationConfig, parse_effects, write_simulation
from ballfg.tracks import TABLE_TENNIS, Track, read_dataset, write_dataset
from ballfg.tracks.info import DatasetInfo

NOISE = 0.001
SPINS = ((0.0, 60.0, 0.0), (3.0, 10.0, 3.0))
"""rad/s, mean and spread, forward, across, up."""
SLOPE, REFERENCE, K = -0.09, 5.0, 0.12
"""Of the planted drag: 27 % more at 2 m/s, 27 % less at 8 m/s."""


def flights(seed: int, count: int, slope: float) -> list[Track]:
    """Shots along x at 2 to 8 m/s, high above the table."""
    rng, times = np.random.default_rng(seed), np.arange(0.0, 0.5, 0.0125)
    effects = [Gravity(), Drag(k=K), Magnus(), DragSpeed(slope=slope, reference=REFERENCE)]
    found = []
    for number in range(count):
        spin = rng.normal(*SPINS)
        state = np.concatenate(([0.0, 0.0, 3.0], [rng.uniform(2.0, 8.0), 0.0, 1.0], spin))
        with torch.no_grad():
            path = paths(
                AnalyticModel(effects),
                torch.from_numpy(state)[None],
                torch.from_numpy(times),
                Surfaces.table_tennis(0.0),
            )
        seen = path[0, :, :3].numpy() + rng.normal(0.0, NOISE, (len(times), 3))
        found.append(Track(times, seen, name=f"{number:03}"))
    return found


def posed(parent: Path, slope: float, count: int = 28) -> Problem:
    info = DatasetInfo(name="curve", table_height=0.0, ball=TABLE_TENNIS, position_noise=NOISE)
    write_dataset(parent / "data", info, flights(7, count, slope))
    dataset = read_dataset(parent / "data")
    config = CalibrationConfig(
        groups="group", coefficients=("flight.drag.k",), data=str(parent / "data"), max_iterations=4
    )
    return pose(dataset, nominal_model(), config)


@pytest.fixture(scope="module")
def curved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Problem, Step, Problem, Step]:
    """The problem with groups and its last step, and those of the correction."""
    problem = posed(tmp_path_factory.mktemp("curve"), SLOPE)
    *_, last = calibrate(problem)
    corrected = pose_correction(problem, last)
    *_, end = calibrate(corrected)
    return problem, last, corrected, end


def drag_curve(model: AnalyticModel, speed: np.ndarray, ratio: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Drag coefficient, 1/m, and the standard deviation that the doubts give it."""
    mean, sigma = learned(model, "drag", speed, ratio)
    k = float(dict(model.named_parameters())["flight.drag.k"].detach())
    return k * (1.0 + mean), k * sigma


def test_a_planted_drag_law_comes_back_inside_its_band(curved: tuple[Problem, Step, Problem, Step]) -> None:
    _, _, corrected, end = curved
    speed = np.linspace(3.3, 7.3, 10)
    ratio = 0.02 * 60.0 / speed
    found, sigma = drag_curve(population_model(corrected, end), speed, ratio)
    right = K * (1.0 + SLOPE * (speed - REFERENCE))
    assert np.all(np.abs(found - right) < 3.0 * sigma + 0.02 * K), (found, right, sigma)
    assert np.all(sigma < 0.25 * K)
    assert found[0] / found[-1] > 1.25  # 1.46 in truth: not the constant that it began with


def test_other_flights_are_predicted_better_and_intervals_hold(curved: tuple[Problem, Step, Problem, Step]) -> None:
    found = []
    for problem, step in (curved[:2], curved[2:]):
        settings = population_settings(replace(problem, settings=curved[2].linearising), step)
        scores = score(problem, population_model(problem, step), settings)
        found.append(summary([one for one in scores if one is not None]))
    plain, better = found
    assert plain is not None
    assert better is not None
    assert better.rmse_median < 0.9 * plain.rmse_median
    assert better.coverage_90 > 0.85


def test_the_listed_correction_is_that_of_the_effect() -> None:
    """The drag of the model over that without a correction, from its acceleration, at the listed places."""
    rng = np.random.default_rng(6)
    effect = AirCorrection(**{name: 0.3 * rng.normal() for name in WEIGHTS})
    model = AnalyticModel([Gravity(g=0.0), Drag(k=K), Magnus(), effect], radius=0.02)
    speed, ratio = places(model)
    state = torch.zeros(len(speed), 9, dtype=torch.float64)
    state[:, 3] = torch.from_numpy(speed)
    state[:, 6] = torch.from_numpy(ratio * speed / 0.02)  # about the flight's direction: no lift
    gain = -model.rates(state)[0][:, 0].detach().numpy() / (K * speed**2)
    found, sigma = learned(model, "drag", speed, ratio)
    np.testing.assert_allclose(1.0 + found, gain, atol=0.01)  # the effect softens the spin at zero
    np.testing.assert_array_equal(sigma, 0.0)


def test_the_picture_has_the_curve_with_its_band(curved: tuple[Problem, Step, Problem, Step], tmp_path: Path) -> None:
    """Drag along the speed, in percent, about the spin ratio in the middle of the samples."""
    _, _, corrected, end = curved
    model = population_model(corrected, end)
    assert [(force, along) for _, force, along in picture._curves(model)] == [("drag", "speed"), ("drag", "ratio")]
    axes = plt.figure().gca()
    picture._correction(axes, model, "drag", "speed")
    shown = next(line for line in axes.lines if "learned" in str(line.get_label()))
    speed, percent = (np.asarray(values, dtype=np.float64) for values in (shown.get_xdata(), shown.get_ydata()))
    low, high = spans(model)["ratio"]
    mean, _ = learned(model, "drag", speed, np.full(len(speed), (low + high) / 2.0))
    np.testing.assert_allclose(percent, 100.0 * mean, atol=1e-9)
    assert axes.get_xlabel() == "speed, m/s"
    draw(corrected, end, compare([], [], [], []), tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 20_000


def test_all_tracks_share_the_weights(curved: tuple[Problem, Step, Problem, Step]) -> None:
    _, _, corrected, end = curved
    weights = corrected.chosen.alike
    assert len(weights) == len(FUNCTIONS)  # without spin labels lift is as declared
    assert np.all(np.array(end.spread)[weights] == 0.0)
    settings = population_settings(corrected, end)
    assert not set(corrected.chosen.shared) & set(settings.coefficients)
    assert sum("doubt" in name for name in settings.coefficients) == DOUBTS


def test_directions_are_a_root_of_the_posterior_and_lead_where_samples_are() -> None:
    """That of drag holds the mean drag's uncertainty: at the samples, of the whole drag force, by differences."""
    rng, count = np.random.default_rng(1), len(FUNCTIONS)
    names, mean = (SCALE, *ALL), np.append(0.12, 0.02 * rng.normal(size=2 * count))
    chosen = Chosen(names, ("1",) * len(names), mean, np.ones(len(names)), mean - 9.0, mean + 9.0, shared=ALL)
    root = 0.003 * rng.normal(size=(len(mean), len(mean)))
    x, y = (torch.from_numpy(0.2 * rng.normal(size=(30, 1))) for _ in range(2))
    samples = correction_terms(x, y).numpy()
    found = Correction(np.zeros(1), (), samples.T @ samples / 30.0).directions(chosen, mean, root @ root.T)
    of_drag, of_lift = np.array(found).reshape(2, count, count)
    lift = chosen.alike[count:]
    np.testing.assert_allclose(of_lift.T @ of_lift, (root @ root.T)[np.ix_(lift, lift)], atol=1e-12)
    weights = chosen.alike[:count]
    moved = (mean[0] + root[0]) * (1.0 + samples @ (mean[weights, None] + root[weights])) / mean[0]
    away = moved - 1.0 - samples @ mean[weights, None]
    np.testing.assert_allclose(np.linalg.norm(of_drag @ samples.T, axis=0), np.linalg.norm(away, axis=1), rtol=0.05)
    shares = np.square(of_drag @ samples.T).sum(axis=1)
    assert shares[:DOUBTS].sum() > 0.9 * shares.sum()


def test_the_width_of_the_prior_is_averaged_by_its_evidence() -> None:
    """Against the densities of the measured weights with every width, and their mixture's moments by draws."""
    rng, count = np.random.default_rng(2), len(FUNCTIONS)
    noise, measured = 0.1, 0.1 * rng.normal(size=count)
    one = Evidence(np.eye(count) / noise**2, measured / noise**2, np.zeros(count))
    columns = (np.zeros(count), np.ones(count), np.full(count, -9.0), np.full(count, 9.0))
    _, found = _widest([one], columns, np.arange(count)[None], np.arange(count), np.arange(count))
    widths = np.array(WIDTHS)
    spreads = np.hypot(noise, widths)[:, None]
    share = np.exp(stats.norm.logpdf(measured, 0.0, spreads).sum(axis=1))
    shrunk = (widths / spreads[:, 0]) ** 2
    picked = rng.choice(len(widths), 200_000, p=share / share.sum())
    draws = measured * shrunk[picked, None] + noise * np.sqrt(shrunk[picked, None]) * rng.normal(size=(200_000, count))
    np.testing.assert_allclose(found.mean, draws.mean(axis=0), atol=2e-3)
    np.testing.assert_allclose(found.covariance, np.cov(draws.T), atol=2e-4)
    assert 0.1 < np.max(share / share.sum()) < 0.9  # more than one width counts


def test_a_run_writes_the_correction_and_continues(tmp_path: Path) -> None:
    problem = posed(tmp_path, SLOPE, 8)
    config = problem.config.model_copy(update={"correction": True, "max_iterations": 1})
    run_calibration(config, tmp_path / "out", resume=False, jobs=1, watch=unwatched)
    first = (tmp_path / "out" / "model.yaml").read_bytes()
    model = load_model(tmp_path / "out" / "model.yaml")
    assert isinstance(model, AnalyticModel)
    effect = model.flight["air_correction"]
    assert isinstance(effect, AirCorrection)
    assert any(effect.values()[name] != 0.0 for name in WEIGHTS)
    assert {f"flight.air_correction.doubt_{k}" for k in range(1, DOUBTS + 1)} <= set(
        dataset_settings(problem.dataset, model).coefficients
    )
    run_calibration(config, tmp_path / "out", resume=True, jobs=1, watch=unwatched)
    assert (tmp_path / "out" / "model.yaml").read_bytes() == first


def test_a_resumed_choice_comes_to_the_same_model(tmp_path: Path) -> None:
    """The candidates that were just compared leave nothing that a later run lacks."""
    config = posed(tmp_path, SLOPE, 24).config.model_copy(update={"kind": "auto", "groups": None})
    run_calibration(config, tmp_path / "out", resume=False, jobs=1, watch=unwatched)
    first = [(tmp_path / "out" / name).read_bytes() for name in ("model.yaml", "report.json")]
    run_calibration(config, tmp_path / "out", resume=True, jobs=1, watch=unwatched)
    assert [(tmp_path / "out" / name).read_bytes() for name in ("model.yaml", "report.json")] == first


def test_a_restitution_that_falls_with_speed_is_not_the_airs(tmp_path: Path) -> None:
    """Its slope comes back, and drag is as declared."""
    slope = 0.025
    hidden = parse_effects([f"restitution_speed.slope={slope}"])
    write_simulation(tmp_path / "data", SimulationConfig(tracks=50, rate=100.0, seed=3, undeclared=hidden))
    model = load_model(tmp_path / "data" / "model.yaml")
    problem = pose(read_dataset(tmp_path / "data"), model, CalibrationConfig(groups="group"))
    *_, last = calibrate(problem)
    corrected = pose_correction(problem, last)
    *_, end = calibrate(corrected)
    found = finished(corrected, end, errors=False)
    k = corrected.chosen.names.index("bounce.restitution_speed.slope")
    sigma = found.step.sigma[k]
    assert sigma < 0.006
    assert abs(found.step.mean[k] - slope) < 3.0 * sigma
    assert found.step.spread[k] == 0.0  # one ball and one table
    assert found.step.next_track[k] == pytest.approx(sigma)
    bounce = found.model.bounce["restitution_speed"].values()
    assert 2.0 < bounce["reference"] < 4.5  # m/s, of the simulated shots
    mean, doubt = learned(found.model, "drag", *places(found.model))
    assert np.all(np.abs(mean) < 2.5 * doubt)


def test_a_second_correction_is_refused() -> None:
    model = AnalyticModel([Gravity(), Drag(), Magnus(), AirCorrection()])
    set_doubts(model, [[0.1] * len(FUNCTIONS)] * 2 * len(FUNCTIONS))
    with pytest.raises(ValueError, match=r"must not have flight\.air_correction yet"):
        with_correction(model, [], labelled=True)
    with pytest.raises(ValueError, match="every one failed"):
        with_correction(nominal_model(), [], labelled=False)


def test_a_correction_needs_groups() -> None:
    with pytest.raises(ValueError, match="correction must come with groups"):
        checked_config({"kind": "calibrate", "correction": True}, "here")


def scored(logs: np.ndarray) -> list[TrackScore | None]:
    rest = {"samples": 5, "rmse": 0.01, "covered": 0.9, "prediction_nis": 3.0, "nis": 3.0}
    return [TrackScore(name=str(k), log_score=float(value), **rest) for k, value in enumerate(logs)]  # type: ignore[arg-type]


def test_a_richer_model_must_surely_beat_the_best_simpler_one() -> None:
    rng = np.random.default_rng(4)
    base, noise = rng.normal(size=50), 0.1 * rng.normal(size=(4, 50))
    noise -= noise.mean(axis=1, keepdims=True)
    error = noise.std(axis=1, ddof=1) / 50**0.5
    least = NOTICED / error[1] - 1.0  # of calibration, which goes only where it surely gains less
    for gains, right in (
        ((0.9, least - 0.1, 0.9, 0.9), NOMINAL),
        ((0.9, least + 0.1, 0.9, 0.9), "calibrated"),
        ((0.9, 0.9, 0.9, 0.9), "calibrated"),
        ((-9.0, 1.1, 0.9, 0.9), "calibrated"),
        ((1.1, 1.1, 5.0, 0.9), GROUPED),
        ((1.1, least - 0.1, 5.0, 0.9), GROUPED),
        ((1.1, -9.0, -9.0, 1.1), CORRECTED),
    ):
        logs, best = [base], base
        for gain, own, sigma in zip(gains, noise, error, strict=True):
            logs.append(best + gain * sigma + own)
            best = logs[-1] if gain > (least if len(logs) == 3 else 1.0) else best
        choice = compared(dict(zip(CANDIDATES, map(scored, logs), strict=True)))
        assert choice.chosen == right
        assert len(choice.table().splitlines()) == 1 + len(CANDIDATES)


def test_a_gain_that_nobody_notices_is_none() -> None:
    """However sure: the same small gain on every track."""
    base = np.random.default_rng(5).normal(size=50)
    rows = {name: scored(base + 0.004 * k) for k, name in enumerate(CANDIDATES)}
    assert compared({name: rows[name] for name in CANDIDATES[:2]}).chosen == NOMINAL
    assert compared(rows).chosen == CORRECTED  # 0.008 over the calibrated one, which has as much over the nominal one
    assert compared({name: rows[name] for name in CANDIDATES[:4]}).chosen == CALIBRATED


def test_forecasts_of_a_track_count_as_one_and_one_that_a_candidate_lacks_counts_for_none() -> None:
    rng = np.random.default_rng(6)
    base, gains = rng.normal(size=(20, 3)), rng.normal(0.1, 0.3, size=(20, 3))
    before, after = (
        [one.model_copy(update={"name": str(k // 3)}) for k, one in enumerate(scored(logs.ravel())) if one is not None]
        for logs in (base, base + gains)
    )
    second = compared({NOMINAL: before, PER_TRACK: after}).candidates[1]
    own = gains.mean(axis=1)
    np.testing.assert_allclose((second.tracks, second.gain), (20, own.mean()))
    np.testing.assert_allclose(second.gain_error, own.std(ddof=1) / 20**0.5)
    without = [None if k == 4 else one for k, one in enumerate(before)]
    lacking = [None if k in (9, 10, 11) else one for k, one in enumerate(after)]
    second = compared({NOMINAL: without, PER_TRACK: lacking}).candidates[1]
    own[1] = (gains[1, 0] + gains[1, 2]) / 2.0
    np.testing.assert_allclose((second.tracks, second.gain), (19, np.delete(own, 3).mean()))


def test_a_run_that_keeps_the_nominal_model_says_so_by_its_status(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = {name: scored(np.array([1.0, 2.0, 3.0])) for name in CANDIDATES}
    monkeypatch.setattr(run, "choose_candidate", lambda *_: (compared(rows), {}))
    problem = posed(tmp_path, 0.0, 8)
    config = problem.config.model_copy(update={"kind": "auto"})
    assert run_calibration(config, tmp_path / "out", resume=False, jobs=1, watch=unwatched) == 1
    assert model_to_dict(load_model(tmp_path / "out" / "model.yaml")) == model_to_dict(nominal_model())  # type: ignore[arg-type]
    assert "No model surely beats the nominal one" in capsys.readouterr().out
    assert (tmp_path / "out" / "choice.json").is_file()


def test_too_few_tracks_leave_no_folder_behind(tmp_path: Path) -> None:
    """Else the same command is refused with more tracks: the folder would hold an earlier run."""
    config = posed(tmp_path, 0.0, 6).config.model_copy(update={"kind": "auto"})
    with pytest.raises(ValueError, match="auto needs 4 tracks to fit; got 3"):
        run_calibration(config, tmp_path / "out", resume=False, jobs=1, watch=unwatched)
    assert not (tmp_path / "out").exists()


def test_on_one_track_no_richer_model_surely_gains() -> None:
    """The spread between tracks is unknown there; calibration alone needs no sureness."""
    one, more = scored(np.array([3.0])), scored(np.array([4.0]))
    choice = compared({"calibrated, without network": one, "with network": more})
    assert choice.chosen == "calibrated, without network"
    assert choice.candidates[1].gain_error is None
    assert "+1.000 ± unknown" in choice.table()
    assert compared({NOMINAL: one, "calibrated": more}).chosen == "calibrated"
    two = compared({"without": scored(np.array([3.0, 3.0])), "with": scored(np.array([4.0, 3.9]))})
    assert two.chosen == "with"


def test_the_config_of_a_candidate() -> None:
    auto = CalibrationConfig(kind="auto", data="shots")
    assert config_of(auto, CORRECTED) == CalibrationConfig(groups="group", correction=True, data="shots")
    assert config_of(auto, "calibrated") == CalibrationConfig(data="shots")
    assert checked_config({"kind": "auto"}, "here") == CalibrationConfig(kind="auto")


def test_the_log_score_is_the_density_of_the_mixture() -> None:
    whitened, sigmas = np.array([0.0, 1.5, 40.0]), np.array([0.01, 0.002, 0.01])
    plain = np.exp(-(whitened**2) / 2) / np.sqrt(2 * np.pi) / sigmas
    wide = np.exp(-((whitened / 10) ** 2) / 2) / np.sqrt(2 * np.pi) / (10 * sigmas)
    np.testing.assert_allclose(log_density(whitened, sigmas), np.log(0.99 * plain + 0.01 * wide), rtol=1e-12)


@pytest.mark.thorough
def test_with_nothing_to_learn_a_simpler_model_is_kept(tmp_path: Path) -> None:
    problem = posed(tmp_path, 0.0, 16)
    choice, found = choose_candidate(replace(problem, config=problem.config.model_copy(update={"kind": "auto"})))
    assert choice.chosen != CORRECTED
    scores = {one.name: one.log_score for one in choice.candidates}
    assert scores[CORRECTED] > scores[GROUPED] - 0.01
    assert all(fitted.problem.shown is not None for fitted in found.values())
