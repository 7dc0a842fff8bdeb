"""Many balls at once on a device that torch computes on, beside machine code on one thread; both must agree."""

from collections.abc import Callable
from functools import partial
from typing import Final

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.benchmarks.metrics import median_and_quartiles
from ballfg.benchmarks.speed.stopwatch import Stopwatch, milliseconds
from ballfg.dynamics import Architecture, BallModel, Surfaces, build, nominal_model, rollout
from ballfg.estimation import Settings, Smoother
from ballfg.estimation.batch import estimate_together
from ballfg.simulation import SimulationConfig, simulate

RADIUS: Final = 0.02
"""m."""
START: Final = (0.0, 0.0, 0.3, 3.0, 0.5, 2.0, 0.0, 80.0, 20.0)
"""m, m/s, rad/s."""
STAMPS: Final = torch.arange(1, 101, dtype=torch.float64) * 0.03
"""s."""
BALLS: Final = (1, 100, 10_000)
"""Rolled out together."""
TRACKS: Final = (10, 100, 1000)
"""Simulated and estimated together."""
RUNS: Final = 3
ROLLOUTS_AGREE: Final = 1e-6
"""m and m/s: after three seconds and several bounces rounding has grown to 1e-11."""
ESTIMATES_AGREE: Final = 1e-6
"""Posterior standard deviations."""


def time_on_device(watch: Stopwatch, device: torch.device) -> None:
    """Rollouts of the nominal model and of `mnn+gs`, and estimates of whole tracks."""
    for name, make in (("nominal", partial(nominal_model, RADIUS)), ("mnn+gs", _network)):
        here, there = make().requires_grad_(False), make().requires_grad_(False).to(device)
        for count in BALLS:
            _time_rollouts(watch, f"{name}, {count} balls", here, there, count, device)
    for count in TRACKS:
        _time_estimates(watch, f"nominal, {count} tracks", count, device)


def _network() -> BallModel:
    return build(Architecture.of("mnn+gs"), radius=RADIUS, seed=1)


def _time_rollouts(
    watch: Stopwatch, row: str, here: BallModel, there: BallModel, count: int, device: torch.device
) -> None:
    """100 stamps over 3 s through bounces, of balls that all differ."""
    spread = torch.linspace(-0.2, 0.2, count, dtype=torch.float64)[:, None] * torch.ones(9, dtype=torch.float64)
    states, ground = torch.tensor(START, dtype=torch.float64) + spread, Surfaces(0.0)

    @torch.no_grad()
    def by_machine_code() -> Array:
        return np.asarray(rollout(here, states, STAMPS, ground).numpy())

    def on_device() -> Array:
        with torch.enable_grad():  # asks for torch where the device is the processor itself
            found = rollout(there, states.to(device), STAMPS.to(device), ground)
        return np.asarray(found.cpu().numpy())  # waits for the device

    off = float(np.abs(on_device() - by_machine_code()).max())
    _record(watch, row, "rollout_100_stamps_time", device, by_machine_code, on_device, off, ROLLOUTS_AGREE)


def _time_estimates(watch: Stopwatch, row: str, count: int, device: torch.device) -> None:
    """Events, minimisation and covariances of simulated tracks at 100 Hz."""
    config = SimulationConfig(tracks=count, seed=5)
    tracks = [shot.track for shot in simulate(config)]
    nominal = nominal_model(RADIUS)
    smoother = Smoother(nominal, config.ball.surfaces, Settings.for_measured(nominal, position_noise=(0.003,) * 3))
    ours, theirs = estimate_together(smoother, tracks, None), estimate_together(smoother, tracks, str(device))
    off = max(float(np.abs((a.states - b.states) / a.sigmas).max()) for a, b in zip(ours, theirs, strict=True))
    here, there = (partial(estimate_together, smoother, tracks, where) for where in (None, str(device)))
    _record(watch, row, "estimates_time", device, here, there, off, ESTIMATES_AGREE)


def _record(
    watch: Stopwatch,
    row: str,
    metric: str,
    device: torch.device,
    here: Callable[[], object],
    there: Callable[[], object],
    off: float,
    most: float,
) -> None:
    """Times of both, in turns, where they agree.

    Raises: RuntimeError: if they do not.
    """
    if not off < most:
        raise RuntimeError(f"{row} on {device} must be those of machine code to {most:g}; they are {off:g} off")
    spent = [(milliseconds(here), milliseconds(there)) for _ in range(RUNS)]
    mine, theirs = zip(*spent, strict=True)
    watch.results.add(watch.case, row, metric, "ms", median_and_quartiles(mine), RUNS)
    watch.results.add(watch.case, row, f"{metric}_{device.type}", "ms", median_and_quartiles(theirs), RUNS)
    watch.results.add(watch.case, row, f"{metric.removesuffix('_time')}_difference_{device.type}", "1", off, 1)
