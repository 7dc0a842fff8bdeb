"""Runs `ballfg-bench speed`: times of an estimate, an update, a prediction and a Jacobian on one thread."""

import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import Final

import numpy as np
import torch

from ballfg.benchmarks.gaussian_settings import StepNoise, gaussian_settings
from ballfg.benchmarks.metrics import median_and_quartiles
from ballfg.benchmarks.results import Results
from ballfg.benchmarks.speed import robot
from ballfg.benchmarks.speed.banded import BandedProblem
from ballfg.benchmarks.speed.network import FIT_ITERATIONS, fitted_network, parameter_count
from ballfg.benchmarks.speed.robot import NO_SURFACE, path_of
from ballfg.benchmarks.speed.stopwatch import Stopwatch, milliseconds
from ballfg.dynamics import AnalyticModel, Architecture, BallModel, build, nominal_model
from ballfg.dynamics.coefficient import coefficient_sigmas
from ballfg.dynamics.model_file import model_from_dict
from ballfg.dynamics.motion.integrate import fly_jacobian
from ballfg.dynamics.networks.learned import LearnedModel
from ballfg.estimation import Online, Smoother, dataset_settings, dataset_surfaces
from ballfg.estimation.settings import Solver
from ballfg.estimation.smoother.problem import Events
from ballfg.estimation.smoother.settle import initial_states
from ballfg.factors.batch import Noise, Values
from ballfg.factors.graph import BallGraph, Minimum
from ballfg.factors.gtsam_solver import GtsamLevenbergMarquardt
from ballfg.factors.linear.covariance import marginal_covariances
from ballfg.learning.end_to_end.end_to_end import SOLUTION_TOLERANCE
from ballfg.learning.end_to_end.pretrain import pretrain
from ballfg.learning.end_to_end.solving import TRAINING
from ballfg.learning.gradient.conjugate_gradients import ConjugateGradients, GaussNewtonFactors
from ballfg.learning.gradient.implicit import GaussNewtonGradient, GradientMethod, ImplicitGradient, UnrolledGradient
from ballfg.learning.gradient.objective import BatchObjective
from ballfg.prediction import Belief, Propagator
from ballfg.progress import progress
from ballfg.tracks import Dataset, Track
from ballfg.tracks.track import SPIN_LABELS

METHODS: Final[Mapping[str, GradientMethod]] = {
    "implicit": ImplicitGradient(),
    "gauss-newton": GaussNewtonGradient(),
    "unrolled": UnrolledGradient(8),
}
EXACT: Final = 1e-12  # Tolerance of the linear solution in the reference gradient; training takes `SOLUTION_TOLERANCE`


def backward(
    model: LearnedModel,
    graph: BallGraph,
    minimum: Minimum,
    method: GradientMethod,
    tolerance: float = SOLUTION_TOLERANCE,
) -> torch.Tensor:
    """Gradient of a fixed linear function of all states by all weights, as one vector."""
    assert minimum.step is not None
    objective = BatchObjective([graph], [minimum.values])
    layout, weights = objective.layout, [p for p in model.parameters() if p.requires_grad]
    factors = GaussNewtonFactors([minimum.step.root])
    point = method(
        lambda: layout.pack([minimum.values]),
        lambda at: objective.gradient(at, Noise()),
        ConjugateGradients(factors, layout.owners(), tolerance),
        weights,
    )
    direction = torch.cos(torch.arange(len(point), dtype=point.dtype))
    gradients = torch.autograd.grad((direction * point).sum(), weights, allow_unused=True)
    pairs = zip(weights, gradients, strict=True)
    return torch.cat([(torch.zeros_like(weight) if g is None else g).reshape(-1) for weight, g in pairs])


CASE = "speed"
SAMPLES = 80
RATE = 100.0  # Hz
NOISE = 0.005  # m
START = (0.0, 0.0, 0.3, 5.0, 0.5, 2.0, 0.0, 80.0, 20.0)
LABEL_OFFSET = (30.0, -20.0, 10.0)  # rad/s, by which the spin label is wrong
LABEL_NOISE = 20.0  # rad/s
DRAG, MAGNUS = 0.112, 0.0055
HORIZON = 0.3  # s that are predicted, at `RATE`
ONLINE: Final[Mapping[Solver, str]] = {"gtsam": "online_update", "ballfg": "online_chain_update"}
"""Solvers of the online estimator's window, and the names of their rows."""


@dataclass(frozen=True)
class Size:
    """The amount of computation."""

    runs: int  # timed runs of each action
    warm_up: int  # runs before them
    fit_iterations: int = FIT_ITERATIONS  # that fit the network to the analytic model
    pretrain_iterations: int = 200
    """That fit the learned model to the analytic one; after 200 its flight is off by 0.1 m/s^2."""
    dataset_tracks: int = 20  # tracks of a dataset that are timed
    flights: int = 80  # simulated ones in a stream at 200 Hz; 80 last 61 s


FULL = Size(runs=60, warm_up=5)
QUICK = Size(runs=5, warm_up=2, flights=4)


def run_speed(results: Results, dataset: Dataset | None, size: Size) -> None:
    """All times; a control before each model and at the end. With a dataset the time for each of some of its tracks."""
    model = problem_model()
    track = problem_track(model)
    watch = Stopwatch(results, CASE, size.runs, size.warm_up, banded_problem(track))
    parts = [
        partial(_time_model, watch, "analytic", model, track),
        partial(robot.time_bounces, watch, "analytic", nominal_model(model.radius), NOISE, LABEL_NOISE),
        partial(_time_network, watch, model, track, size.fit_iterations),
        partial(_time_coefficients, watch, model, track),
        partial(_time_gradients, watch, model, track, size.pretrain_iterations),
        partial(robot.time_growth, watch, "analytic", model, START, NOISE),
        *(partial(robot.time_stream, watch, solver, size.flights) for solver in ONLINE),
        partial(robot.time_stream, watch, "gtsam", size.flights, robot.BUDGET),
        partial(robot.time_events, watch),
        partial(robot.time_rollouts, watch),
    ]
    for part in progress(parts, len(parts), "parts timed"):
        part()
    if dataset is not None:
        _time_dataset(results, dataset, size.dataset_tracks)
    watch.control("control")


def problem_model() -> AnalyticModel:
    """Gravity, drag and Magnus force; nothing to bounce on."""
    flight = {"gravity": {"g": 9.81}, "drag": {"k": DRAG}, "magnus": {"k": MAGNUS}}
    return model_from_dict({"flight": flight, "bounce": {}})


def problem_track(model: BallModel) -> Track:
    """80 observations of one free flight, with a spin label that is off."""
    times, rng = np.arange(SAMPLES) / RATE, np.random.default_rng(0)
    measured = path_of(model, START, times, NO_SURFACE) + NOISE * rng.standard_normal((SAMPLES, 3))
    spin = np.add(START[6:], LABEL_OFFSET).tolist()
    return Track(times, measured, labels=dict(zip(SPIN_LABELS, spin, strict=True)), name="speed")


def banded_problem(track: Track) -> BandedProblem:
    """The same flight for the control."""
    label = np.array([track.labels[name] for name in SPIN_LABELS])
    return BandedProblem(track.positions, 1.0 / RATE, NOISE, label, LABEL_NOISE, DRAG, MAGNUS)


problem_settings = partial(gaussian_settings, NOISE, StepNoise(), LABEL_NOISE)
"""1 mm and 1 cm/s of process noise a step, squared losses; optionally coefficients estimated with the track."""


def _problem(smoother: Smoother, track: Track) -> tuple[BallGraph, Values]:
    problem = smoother.problem(track)
    states = initial_states(track, (), problem.segmentation, smoother.model, smoother.settings.spin_label(track))
    return problem.graph(Events((), problem.segmentation)), problem.start(states)


def _time_model(watch: Stopwatch, name: str, model: BallModel, track: Track) -> None:
    """Everything for one model of the flight, which is known exactly."""
    settings = problem_settings()
    smoother = Smoother(model, NO_SURFACE, settings)
    graph, values = _problem(smoother, track)
    watch.control(name)
    _time_minimisation(watch, name, smoother, graph, values)
    watch.time(name, "lm_time_gtsam", lambda: GtsamLevenbergMarquardt().minimize(graph, values))
    watch.time(name, "estimate_time", lambda: smoother.estimate(track))
    states, dt = torch.from_numpy(values.states[:-1].copy()), torch.full((SAMPLES - 1,), 1 / RATE, dtype=torch.float64)
    watch.time(name, "jacobians_time_79", lambda: fly_jacobian(model, states, dt))
    watch.time(name, "jacobian_time_1", lambda: fly_jacobian(model, states[:1], dt[:1]))
    for solver, metric in ONLINE.items():
        _time_online(watch, name, metric, Online(model, NO_SURFACE, replace(settings, solver=solver)), track)
    propagator = Propagator(smoother.surfaces, settings.process)
    times = track.times[-1] + np.arange(1, round(HORIZON * RATE) + 1) / RATE
    belief = Belief.of(model, [smoother.estimate(track).last])
    watch.time(name, "prediction_time", lambda: propagator.rollout(belief, times))


def _time_network(watch: Stopwatch, model: AnalyticModel, track: Track, iterations: int) -> None:
    """The same for a network that is fitted to the analytic model."""
    network = fitted_network(model, iterations)
    _time_model(watch, "network", network, track)
    bouncing = copy.deepcopy(network)
    bouncing.bounces = nominal_model(model.radius)
    robot.time_bounces(watch, "network", bouncing, NOISE, LABEL_NOISE)
    watch.add("network", "parameters", parameter_count(network))


def _time_coefficients(watch: Stopwatch, model: AnalyticModel, track: Track) -> None:
    """The analytic model again, with its drag and Magnus coefficients estimated along with the track."""
    name = "analytic+coefficients"
    smoother = Smoother(model, NO_SURFACE, problem_settings(coefficient_sigmas(model)))
    _time_minimisation(watch, name, smoother, *_problem(smoother, track))
    watch.time(name, "estimate_time", lambda: smoother.estimate(track))


def _time_gradients(watch: Stopwatch, model: AnalyticModel, track: Track, iterations: int) -> None:
    """The gradient through the estimate, with the learned model that the analytic one was put into.

    Forward: from the first guess to the minimum. Backward: from a derivative by all states to one by all weights;
    building the torch objective belongs to it.
    """
    learned = build(Architecture.of("mnn+gs"), radius=model.radius)
    pretrain(learned, model, 0, iterations)
    graph, start = _problem(Smoother(learned, NO_SURFACE, problem_settings()), track)
    minimum, kind = TRAINING.minimize(graph, start), learned.architecture.kind
    forward = watch.time(kind, "forward_time", lambda: TRAINING.minimize(graph, start))
    exact = backward(learned, graph, minimum, ImplicitGradient(), EXACT)
    for name, method in METHODS.items():
        row, once = f"{kind}, {name}", partial(backward, learned, graph, minimum, method)
        found = once()
        figure = watch.time(row, "backward_time", once)
        watch.add(row, "backward_over_forward", figure.value / forward.value, watch.runs)
        watch.add(row, "gradient_error", float((found - exact).norm() / exact.norm()))


def _time_minimisation(watch: Stopwatch, name: str, smoother: Smoother, graph: BallGraph, values: Values) -> None:
    """Levenberg-Marquardt on the built graph, from the initial guess to the minimum; then the covariances."""
    optimizer = smoother.optimizer
    minimum = optimizer.minimize(graph, values)
    step = minimum.step
    assert step is not None
    watch.time(name, "lm_time", lambda: optimizer.minimize(graph, values))
    watch.time(name, "covariances_time", lambda: marginal_covariances(step.root))
    watch.add(name, "lm_iterations", minimum.iterations)


def _time_online(watch: Stopwatch, name: str, metric: str, online: Online, track: Track) -> None:
    """Every update with its newest state and covariance, over whole streams; the first stream warms up."""
    runs: list[list[float]] = []
    for _ in range(1 + max(2, watch.runs // 10)):
        online.reset()
        stream = zip(track.times.tolist(), track.positions, strict=True)
        runs.append([milliseconds(partial(online.push, stamp, position)) for stamp, position in stream])
    times = [spent for run in runs[1:] for spent in run]
    watch.results.add(CASE, name, f"{metric}_median", "ms", median_and_quartiles(times), len(times))
    watch.results.add(CASE, name, f"{metric}_p99", "ms", float(np.quantile(times, 0.99)), len(times))


def _time_dataset(results: Results, dataset: Dataset, count: int) -> None:
    model = nominal_model(dataset.info.ball)
    smoother = Smoother(model, dataset_surfaces(dataset), dataset_settings(dataset, model))
    tracks, name = list(islice(dataset, count)), dataset.info.name
    smoother.estimate(tracks[0])  # warm
    shown = progress(tracks, len(tracks), "tracks timed")
    times = [milliseconds(partial(smoother.estimate, track)) for track in shown]
    results.add(name, "smoother", "estimate_time", "ms", median_and_quartiles(times), len(tracks))
    samples = float(np.median([len(track) for track in tracks]))
    results.add(name, "smoother", "samples_median", "1", samples, len(tracks))
