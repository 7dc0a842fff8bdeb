"""Times a robot's requests during a flight: an estimate through bounces, a stream, events ahead, many rollouts."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
import torch

from ballfg.benchmarks.gaussian_settings import StepNoise, gaussian_settings
from ballfg.benchmarks.metrics import median_and_quartiles
from ballfg.benchmarks.speed.stopwatch import Stopwatch, milliseconds
from ballfg.dynamics import Architecture, BallModel, Surfaces, build, nominal_model, rollout
from ballfg.estimation import Online, Settings, Smoother
from ballfg.estimation.settings import Solver
from ballfg.prediction import next_contact, plane_crossing
from ballfg.prediction.forecast import carried_by
from ballfg.simulation import SimulationConfig, simulate
from ballfg.tracks import Track
from ballfg.tracks.track import SPIN_LABELS

RADIUS: Final = 0.02  # m
GROUND: Final = Surfaces(0.0)
NO_SURFACE: Final = Surfaces(-1e3)
BOUNCING: Final = (0.0, 0.0, 0.3, 5.0, 0.5, -0.5, 0.0, 80.0, 20.0)
"""m, m/s, rad/s: a ball that bounces twice within 80 samples at 100 Hz."""
LONG: Final = (20, 80, 320, 1280)  # Observations of one flight
DENSE: Final = 400.0  # Hz, rate of these observations, so that the longest flight stays below a plausible speed
STREAM_RATE: Final = 200.0  # Hz
STREAM_NOISE: Final = 0.003  # m, as the simulation has it
PAUSE: Final = 1.5  # s between two flights of a stream
STEPS: Final = 300  # Number of steps of 10 ms in a rollout
SLOWEST: Final = 3  # Runs of what takes seconds
BUDGET: Final = 4.0  # ms, of a push


def time_bounces(watch: Stopwatch, name: str, model: BallModel, noise: float, label_noise: float) -> None:
    """A whole estimate through two bounces: events, graph, minimisation, covariances."""
    times, rng = np.arange(80) / 100.0, np.random.default_rng(3)
    positions = path_of(nominal_model(RADIUS), BOUNCING, times) + noise * rng.standard_normal((80, 3))
    spin = np.add(BOUNCING[6:], (30.0, -20.0, 10.0)).tolist()
    track = Track(times, positions, labels=dict(zip(SPIN_LABELS, spin, strict=True)), name="bounces")
    smoother = Smoother(model, GROUND, gaussian_settings(noise, StepNoise(), label_noise))
    if len(smoother.estimate(track).contacts) != 2:
        raise RuntimeError("the estimate must find two contacts, or its time says nothing")
    watch.time(name, "estimate_time_two_bounces", lambda: smoother.estimate(track))


def time_growth(watch: Stopwatch, name: str, model: BallModel, start: Sequence[float], noise: float) -> None:
    """Time of an estimate for each of its observations."""
    for count in LONG:
        times, rng = np.arange(count) / DENSE, np.random.default_rng(0)
        positions = path_of(model, start, times, NO_SURFACE) + noise * rng.standard_normal((count, 3))
        smoother = Smoother(model, NO_SURFACE, gaussian_settings(noise, StepNoise(), 20.0))
        track = Track(times, positions, name="long")
        spent = median_and_quartiles([milliseconds(partial(smoother.estimate, track)) for _ in range(watch.runs)])
        watch.add(name, f"estimate_us_per_observation_{count}", 1e3 * spent.value / count, watch.runs)


def time_stream(watch: Stopwatch, solver: Solver, flights: int, budget_ms: float | None = None) -> None:
    """Every push of a stream of simulated flights, with the state that it returns, after `Online.warm_up`."""
    shots = [shot.track for shot in simulate(SimulationConfig(tracks=flights, rate=STREAM_RATE, seed=5))]
    nominal, table = nominal_model(RADIUS), SimulationConfig().ball.surfaces
    learned = build(Architecture.of("mnn+gs", residual=True), radius=RADIUS, base=nominal).requires_grad_(False)
    for name, model in (("mnn+gs", learned), ("nominal", nominal)):
        settings = Settings.for_measured(model, position_noise=(STREAM_NOISE,) * 3, solver=solver)
        online = Online(model, table, settings, budget_ms=budget_ms)
        online.warm_up()
        spent, begin = [], 0.0
        for shot in shots:
            for time, position in zip(shot.times, shot.positions, strict=True):
                spent.append(milliseconds(partial(online.push, begin + time, position)))
            begin += shot.times[-1] + PAUSE
        row, count = f"{name}, {solver}", len(spent)
        row += "" if budget_ms is None else f", budget {budget_ms:g} ms"
        watch.results.add(watch.case, row, "stream_push_median", "ms", median_and_quartiles(spent), count)
        for share, metric in ((0.99, "stream_push_p99"), (0.999, "stream_push_p999"), (1.0, "stream_push_worst")):
            watch.results.add(watch.case, row, metric, "ms", float(np.quantile(spent, share)), count)


def time_events(watch: Stopwatch) -> None:
    """From a state in flight, with sigmas: the path of 0.3 s, the next bounce, the crossing of a plane."""
    nominal = nominal_model(RADIUS)
    online = Online(nominal, GROUND, replace(gaussian_settings(0.002, StepNoise(), 20.0), solver="ballfg"))
    times = np.arange(40) / STREAM_RATE
    start = (0.0, 0.0, 0.3, 4.0, 0.1, 1.0, 0.0, 50.0, 0.0)
    for time, position in zip(times, path_of(nominal, start, times), strict=True):
        state = online.push(time, position)
    for metric, ask in (
        ("predict_30_stamps_time", lambda: state.predict(0.3)),
        ("next_bounce_time", lambda: next_contact(*carried_by(state), 1.0)),
        ("plane_crossing_time", lambda: plane_crossing(*carried_by(state), (1.0, 0.0, 0.0), 1.6, 1.0)),
    ):
        if ask() is None:
            raise RuntimeError(f"{metric} must find its event, or its time says nothing")
        watch.time("nominal", metric, ask)


def time_rollouts(watch: Stopwatch) -> None:
    """300 steps of `mnn+gs` through bounces, by machine code and by torch."""
    model = build(Architecture.of("mnn+gs"), radius=RADIUS, seed=1).requires_grad_(False)
    times = torch.arange(1, STEPS + 1, dtype=torch.float64) / 100.0
    one = torch.tensor([(0.0, 0.0, 0.3, 3.0, 0.5, 2.0, 0.0, 80.0, 20.0)], dtype=torch.float64)
    watch.time("mnn+gs", "rollout_time", torch.no_grad()(lambda: rollout(model, one, times, GROUND)))
    spent = [milliseconds(torch.enable_grad()(lambda: rollout(model, one, times, GROUND))) for _ in range(SLOWEST)]
    watch.results.add(watch.case, "mnn+gs", "rollout_time_torch", "ms", median_and_quartiles(spent), SLOWEST)


def path_of(model: BallModel, start: Sequence[float], times: np.ndarray, surfaces: Surfaces = GROUND) -> np.ndarray:
    """(n, 3) m, where a ball is at times (n,) s."""
    with torch.no_grad():
        states = rollout(model, torch.tensor([list(start)], dtype=torch.float64), torch.from_numpy(times), surfaces)
    return states[0, :, :3].numpy()
