"""How well the questions about a ball's future are answered: planes, apex, next contact, and their probabilities.

    python -m tests.prediction.questions --sets 12 --tracks 100 --seed 1

simulates sets of shots with random accelerations and kicks at bounces, measures them at 100 Hz, predicts each from 0.15
to 0.3 s of it with the noise that the seen parts show, and compares with the true path at 1000 Hz: the share of 90 %
intervals that hold the time and the place of an event; and, in ten bins of the stated probability, the share of balls
that have it. Planes are placed about where each ball may just pass them, by its own prediction.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy import stats

import ballfg as bf
from ballfg.arrays import Array
from ballfg.dynamics import nominal_model
from ballfg.estimation.configure import dataset_surfaces, fitted_settings
from ballfg.prediction.forecast import Forecast
from ballfg.prediction.plane import APEX, CONTACT, Plane
from ballfg.simulation import MeasurementNoise, MotionNoise, SimulationConfig
from ballfg.simulation.synthetic import dataset_info, simulate
from ballfg.state import POSITION, VZ
from ballfg.tracks import Track
from ballfg.tracks.dataset import dataset_in_memory

DENSE, EACH = 1000.0, 10
"""Hz of the true path, and how many of its samples make one that is measured."""
HORIZON, STEP = 0.5, 0.005
"""s, as `ballfg predict` has it in its steps."""
HALF = 1.645
BINS = np.linspace(0.0, 1.0, 11)


@dataclass
class Answers:
    """Errors of events in standard deviations, and stated probabilities with what happened, by question."""

    times: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    places: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    stated: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    happened: dict[str, list[bool]] = field(default_factory=lambda: defaultdict(list))

    def add(self, name: str, found: object, truth: tuple[float, Array] | None) -> None:
        """Adds an event of a forecast, with its true time and place if the ball has one."""
        self.stated[name].append(found.probability)
        self.happened[name].append(truth is not None)
        if found.crossing is None or truth is None:
            return
        time, place = truth
        self.times[name].append((found.crossing.time - time) / found.crossing.time_sigma)
        sigmas = np.sqrt(np.diagonal(found.crossing.covariance)[POSITION])
        off = (found.crossing.state[POSITION] - place) / np.maximum(sigmas, 1e-9)
        asked = sigmas > 1e-5  # across the plane there is nothing to state
        asked[2] &= not name.startswith("contact")  # nor above the table
        self.places[name] += off[asked].tolist()

    def print(self) -> None:
        """Prints shares and bins."""
        for name in self.stated:
            held = [100 * np.mean(np.abs(values[name]) < HALF) for values in (self.times, self.places) if values[name]]
            count = len(self.times[name])
            print(
                f"{name}: {count} events; 90 % intervals hold time and place: {', '.join(f'{h:.1f} %' for h in held)}"
            )
        times, places = (np.concatenate([*values.values()]) for values in (self.times, self.places))
        print(f"all: {100 * np.mean(np.abs(times) < HALF):.1f} % of {len(times)} times, "
              f"{100 * np.mean(np.abs(places) < HALF):.1f} % of {len(places)} places")  # fmt: skip
        stated, happened = (np.concatenate([*values.values()]) for values in (self.stated, self.happened))
        outside = 0
        for low, high in pairwise(BINS.tolist()):
            inside = (stated >= low) & ((stated < high) | (high == 1.0))
            count = int(inside.sum())
            mean = float(stated[inside].mean()) if count else float("nan")
            band = stats.binom.interval(0.99, count, mean) if count else (0, 0)
            right = band[0] <= happened[inside].sum() <= band[1]
            outside += not right
            print(f"  {low:.1f} to {high:.1f}: {count} stated, mean {mean:.3f}, happened {happened[inside].mean():.3f}"
                  f"{'' if right else '  outside of the binomial band of 99 %'}")  # fmt: skip
        print(f"{10 - outside} of 10 bins within their bands")


def crossing(times: Array, states: Array, plane: Plane) -> tuple[float, Array] | None:
    """Time and place of the first crossing of a true path in a plane's direction, linear between its samples."""
    normal, offset = plane.line
    height = states[:, POSITION] @ np.array(normal) - offset
    signs = {"up": (1,), "down": (-1,), "either": (1, -1)}[plane.direction]
    for i in range(len(height) - 1):
        if height[i] * height[i + 1] < 0.0 and np.sign(height[i + 1]) in signs:
            share = height[i] / (height[i] - height[i + 1])
            return times[i] + share * (times[i + 1] - times[i]), states[i, POSITION] + share * (
                states[i + 1, POSITION] - states[i, POSITION]
            )
    return None


def turn(times: Array, states: Array, way: int) -> tuple[float, Array] | None:
    """The first apex (way -1: the vertical speed falls through zero) or contact (1: it jumps up) of a true path."""
    speeds = states[:, VZ]
    for i in range(len(times) - 1):
        if way < 0 and speeds[i] > 0.0 >= speeds[i + 1]:
            share = speeds[i] / (speeds[i] - speeds[i + 1])
            return times[i] + share * (times[i + 1] - times[i]), states[i, POSITION]
        if way > 0 and speeds[i] < 0.0 < speeds[i + 1] - 0.3:
            # arcs before and after meet: height and speeds of the neighbours give the time
            met = states[i + 1, 2] - states[i, 2] - speeds[i + 1] * (times[i + 1] - times[i])
            later = met / (speeds[i] - speeds[i + 1])
            return times[i] + later, states[i, POSITION] + later * states[i, 3:6]
    return None


def within(event: tuple[float, Array] | None, last: float) -> tuple[float, Array] | None:
    """An event up to a time, s; None if it is later."""
    return event if event is not None and event[0] <= last else None


def ask(ahead: Forecast, times: Array, states: Array, rng: np.random.Generator, answers: Answers) -> None:
    """The questions about one ball; times (n,) s and states (n, 9) of its true future."""
    last = ahead.start.time + ahead.horizon
    reached = ahead.start.state[POSITION][0] + ahead.start.state[3] * rng.uniform(0.1, 0.9) * ahead.horizon
    for name, plane in (
        ("x", Plane((1.0, 0.0, 0.0), float(reached))),
        ("z down", Plane((0.0, 0.0, 1.0), float(ahead.start.state[2] - rng.uniform(0.02, 0.2)), "down")),
    ):
        answers.add(name, ahead.event(plane), within(crossing(times, states, plane), last))
    for name, asked, way in (("apex", APEX, -1), ("contact", CONTACT, 1)):
        answers.add(name, ahead.event(asked), within(turn(times, states, way), last))
    top = ahead.event(APEX).crossing
    if top is not None:
        height = top.state[2] + rng.normal(0.0, 1.2) * np.sqrt(top.covariance[2, 2])
        plane = Plane((0.0, 0.0, 1.0), float(height), str(rng.choice(("up", "down"))))
        answers.add("z near the apex", ahead.event(plane), within(crossing(times, states, plane), last))


def near_the_end(start: bf.BallState, times: Array, states: Array, rng: np.random.Generator, answers: Answers) -> None:
    """Contacts and planes that the ball may just have within the horizon."""
    contact = start.predict(HORIZON, STEP).event(CONTACT).crossing
    if contact is not None:
        horizon = contact.time + rng.normal(0.0, 1.2) * contact.time_sigma - start.time
        if horizon > 0.02:
            ahead = start.predict(horizon, STEP)
            happened = within(turn(times, states, 1), start.time + horizon)
            answers.add("contact in time", ahead.event(CONTACT), happened)


def judge(config: SimulationConfig, rng: np.random.Generator, answers: Answers) -> None:
    """Adds the answers about the shots of a set, with the noise that their seen parts show."""
    made = list(simulate(config))
    tracks = [Track(s.track.times[::EACH], s.track.positions[::EACH], name=s.track.name) for s in made]
    data = dataset_in_memory(dataset_info(config), tracks)
    model, surfaces = nominal_model(data.ball), dataset_surfaces(data)
    smoother = bf.Smoother(model, surfaces, fitted_settings(data, model, 0.25))
    for simulated, track in zip(made, tracks, strict=True):
        estimate = smoother.estimate(track.opening(float(rng.uniform(0.15, 0.3))))
        if estimate.status is not bf.Status.OK:
            continue
        start = estimate.last
        later = simulated.true_times > start.time - 0.5 / DENSE
        times, states = simulated.true_times[later], simulated.true_states[later]
        if len(times) and times[-1] > start.time + HORIZON:
            ask(start.predict(HORIZON, STEP), times, states, rng, answers)
            near_the_end(start, times, states, rng, answers)


def main() -> None:
    """Prints the answers to all questions."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--sets", type=int, default=12)
    parser.add_argument("--tracks", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    rng, answers = np.random.default_rng(chosen.seed), Answers()
    for seed in range(chosen.seed, chosen.seed + chosen.sets):
        noise = float(rng.uniform(0.001, 0.004))
        process = MotionNoise(acceleration=0.1, contact_velocity=0.05, contact_spin=5.0)
        judge(SimulationConfig(
            tracks=chosen.tracks, rate=DENSE, seed=seed, noise=MeasurementNoise(position=noise), process=process,
            spin_labels=False,
        ), rng, answers)  # fmt: skip
    answers.print()


if __name__ == "__main__":
    main()
