"""`ballfg-bench speed`: what an estimate, an update, a prediction and a Jacobian cost on one thread."""

from __future__ import annotations

import time
from collections.abc import Callable

import gtsam
import numpy as np
import torch
from numpy.typing import NDArray

from ballfg.benchmarks.estimators.step_noise import StepNoise
from ballfg.benchmarks.metrics import Figure
from ballfg.benchmarks.results import Results
from ballfg.benchmarks.speed.gradient_cost import time_gradients
from ballfg.benchmarks.speed.network import fitted_network, parameter_count
from ballfg.benchmarks.synthetic import gaussian_settings
from ballfg.benchmarks.timing import Stopwatch, quartiles
from ballfg.dynamics import AnalyticModel, BallModel, Surfaces, fly_jacobian, model_from_dict, nominal_model, rollout
from ballfg.dynamics.analytic import coefficient_sigmas
from ballfg.dynamics.networks.architecture import Architecture
from ballfg.dynamics.networks.learned import build
from ballfg.estimation import Estimator, Online, Settings, Smoother, dataset_settings, dataset_surfaces
from ballfg.estimation.smoother.initial import initial_states
from ballfg.estimation.smoother.problem import Events, build_graph, effective_sigmas, initial_values
from ballfg.factors.batch import Values
from ballfg.factors.bridge import nonlinear_graph, to_gtsam
from ballfg.factors.covariance import marginal_covariances
from ballfg.factors.graph import BallGraph
from ballfg.learning.end_to_end.pretrain import pretrain
from ballfg.prediction import Belief, Propagator
from ballfg.progress import progress
from ballfg.state import POSITION
from ballfg.tracks import SPIN_LABELS, Dataset, Track

Array = NDArray[np.float64]

CASE = "speed"
SAMPLES = 80
RATE = 100.0
"""Hz."""
NOISE = 0.005
"""m."""
START = (0.0, 0.0, 0.3, 5.0, 0.5, 2.0, 0.0, 80.0, 20.0)
LABEL_OFFSET = (30.0, -20.0, 10.0)
"""rad/s, by which the spin label is wrong."""
LABEL_NOISE = 20.0
"""rad/s."""
DRAG, MAGNUS = 0.112, 0.0055
HORIZON = 0.3
"""s that are predicted, at `RATE`."""
NO_SURFACE = Surfaces(-1e3)
PRETRAIN = 200
"""Iterations that fit the learned model to the analytic one; its flight is then off by 0.1 m/s^2."""
DATASET_TRACKS = 20
"""Tracks of a dataset that are timed."""


def run_speed(results: Results, dataset: Dataset | None, quick: bool) -> None:
    """All times; a control before each model and at the end; with a dataset the time for each of some of its tracks."""
    watch = Stopwatch(runs=5, warm_up=2) if quick else Stopwatch(runs=60)
    model = problem_model()
    network = fitted_network(model)
    models: dict[str, BallModel] = {"analytic": model, "network": network}
    track = problem_track(model)
    for name, ball in progress(models.items(), len(models), "models timed"):
        _time_model(results, name, ball, track, watch)
    _time_coefficients(results, model, track, watch)
    _time_gradients(results, model, track, watch)
    results.add(CASE, "network", "parameters", "1", parameter_count(network), 1)
    if dataset is not None:
        _time_dataset(results, dataset)
    results.add(CASE, "control", "matrix_product_time", "ms", watch.control(), watch.runs)


def problem_model() -> AnalyticModel:
    """Gravity, drag and Magnus force; nothing to bounce on."""
    flight = {"gravity": {"g": 9.81}, "drag": {"k": DRAG}, "magnus": {"k": MAGNUS}}
    return model_from_dict({"flight": flight, "bounce": {}})


def problem_track(model: BallModel) -> Track:
    """80 observations of one free flight, with a spin label that is off."""
    start = torch.tensor([START], dtype=torch.float64)
    times = np.arange(SAMPLES) / RATE
    with torch.no_grad():
        truth = rollout(model, start, torch.from_numpy(times), NO_SURFACE)[0].numpy()
    rng = np.random.default_rng(0)
    measured = truth[:, POSITION] + NOISE * rng.standard_normal((SAMPLES, 3))
    spin = np.add(START[6:], LABEL_OFFSET)
    return Track("speed", times, measured, labels=dict(zip(SPIN_LABELS, map(float, spin), strict=True)))


def problem_settings(coefficients: dict[str, float] | None = None) -> Settings:
    """1 mm and 1 cm/s of process noise a step, squared losses; optionally coefficients estimated with the track."""
    return gaussian_settings(NOISE, StepNoise(), LABEL_NOISE, coefficients)


def _problem(smoother: Smoother, track: Track) -> tuple[BallGraph, Values]:
    """The track's graph and the point from which the minimisation starts."""
    segmentation = smoother.segment(track)
    sigma = effective_sigmas(track, segmentation, smoother.settings)
    graph = build_graph(track, smoother.trackwise, Events((), segmentation), sigma, smoother.settings)
    states = initial_states(track, (), segmentation, smoother.model, smoother.settings.spin_label(track))
    return graph, initial_values(states, smoother.trackwise, smoother.settings)


def _time_model(results: Results, name: str, model: BallModel, track: Track, watch: Stopwatch) -> None:
    """Everything for one model of the flight, which is known exactly."""
    settings = problem_settings()
    smoother = Smoother(model, NO_SURFACE, settings)
    graph, values = _problem(smoother, track)
    results.add(CASE, name, "matrix_product_time", "ms", watch.control(), watch.runs)
    _time_minimisation(results, name, smoother, graph, values, watch)
    _time_gtsam(results, name, graph, values, watch)
    add = _adder(results, name, watch)
    add("estimate_time", watch.time(lambda: smoother.estimate(track)))
    states, dt = torch.from_numpy(values.states[:-1].copy()), torch.full((SAMPLES - 1,), 1 / RATE, dtype=torch.float64)
    add("jacobians_time_79", watch.time(lambda: fly_jacobian(model, states, dt)))
    add("jacobian_time_1", watch.time(lambda: fly_jacobian(model, states[:1], dt[:1])))
    _time_online(results, name, Online(model, NO_SURFACE, settings), track, watch)
    _time_prediction(results, name, smoother, track, watch)


def _time_gradients(results: Results, model: AnalyticModel, track: Track, watch: Stopwatch) -> None:
    """The gradient through the estimate, with the learned model that the analytic one was put into."""
    learned = build(Architecture.of("mnn+gs"), radius=model.radius)
    pretrain(learned, model, 0, PRETRAIN)
    graph, values = _problem(Smoother(learned, NO_SURFACE, problem_settings()), track)
    time_gradients(results, CASE, learned, graph, values, watch)


def _adder(results: Results, method: str, watch: Stopwatch) -> Callable[[str, Figure], None]:
    def add(metric: str, figure: Figure) -> None:
        results.add(CASE, method, metric, "ms", figure, watch.runs)

    return add


def _time_minimisation(
    results: Results, name: str, smoother: Smoother, graph: BallGraph, values: Values, watch: Stopwatch
) -> None:
    """Levenberg-Marquardt on the built graph, from the initial guess to the minimum; then the covariances."""
    optimizer = smoother.optimizer
    minimum = optimizer.minimize(graph, values)
    step = minimum.step
    assert step is not None
    n, p = values.states.shape[0], len(values.coefficients)
    add = _adder(results, name, watch)
    add("lm_time", watch.time(lambda: optimizer.minimize(graph, values)))
    add("covariances_time", watch.time(lambda: marginal_covariances(step.bayes_net, n, p)))
    results.add(CASE, name, "lm_iterations", "1", minimum.iterations, 1)


def _time_gtsam(results: Results, name: str, graph: BallGraph, values: Values, watch: Stopwatch) -> None:
    """GTSAM's own Levenberg-Marquardt on CustomFactors that are answered from batches, to the same minimum."""
    start = to_gtsam(values)

    def minimise() -> float:
        factors, _ = nonlinear_graph(graph)
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setRelativeErrorTol(1e-12)
        parameters.setAbsoluteErrorTol(1e-12)
        return float(gtsam.LevenbergMarquardtOptimizer(factors, start, parameters).optimize().size())

    results.add(CASE, name, "lm_time_gtsam", "ms", watch.time(minimise), watch.runs)


def _time_coefficients(results: Results, model: AnalyticModel, track: Track, watch: Stopwatch) -> None:
    """The analytic model again, with its drag and Magnus coefficients estimated along with the track."""
    smoother = Smoother(model, NO_SURFACE, problem_settings(coefficient_sigmas(model)))
    graph, values = _problem(smoother, track)
    _time_minimisation(results, "analytic+coefficients", smoother, graph, values, watch)
    figure = watch.time(lambda: smoother.estimate(track))
    results.add(CASE, "analytic+coefficients", "estimate_time", "ms", figure, watch.runs)


def _time_online(results: Results, name: str, online: Online, track: Track, watch: Stopwatch) -> None:
    """Every update with its newest state and covariance, over whole streams; the first stream warms up."""
    times = []
    for run in range(1 + max(2, watch.runs // 10)):
        online.reset()
        for stamp, position in zip(track.times.tolist(), track.positions, strict=True):
            start = time.perf_counter()
            online.push(stamp, position)
            if run:
                times.append(1e3 * (time.perf_counter() - start))
    n = len(times)
    results.add(CASE, name, "online_update_median", "ms", quartiles(np.array(times)), n)
    results.add(CASE, name, "online_update_p99", "ms", float(np.quantile(times, 0.99)), n)


def _time_prediction(results: Results, name: str, estimator: Estimator, track: Track, watch: Stopwatch) -> None:
    """The next 0.3 s with covariances, from an estimate."""
    estimate = estimator.estimate(track)
    propagator = Propagator(estimator.surfaces, estimator.settings.process)
    times = torch.from_numpy(track.times[-1] + np.arange(1, round(HORIZON * RATE) + 1) / RATE)[None]
    belief = Belief.last(estimator.model, [estimate])
    figure = watch.time(lambda: propagator.rollout(belief, times))
    results.add(CASE, name, "prediction_time", "ms", figure, watch.runs)


def _time_dataset(results: Results, dataset: Dataset) -> None:
    """Time of the smoother for each of the first tracks of a dataset."""
    model = nominal_model(dataset.info.ball.radius)
    smoother = Smoother(model, dataset_surfaces(dataset), dataset_settings(dataset, model))
    tracks = [track for track, _ in zip(dataset, range(DATASET_TRACKS), strict=False)]
    smoother.estimate(tracks[0])  # warm
    times = []
    for track in progress(tracks, len(tracks), "tracks timed"):
        start = time.perf_counter()
        smoother.estimate(track)
        times.append(1e3 * (time.perf_counter() - start))
    name = dataset.info.name
    results.add(name, "smoother", "estimate_time", "ms", quartiles(np.array(times)), len(tracks))
    samples = float(np.median([len(track) for track in tracks]))
    results.add(name, "smoother", "samples_median", "1", samples, len(tracks))
