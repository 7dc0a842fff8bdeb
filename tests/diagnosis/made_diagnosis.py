"""Diagnoses made by hand: fifty shots in a wind of 0.2 m/s that nobody declared, nothing, and what has no name."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.diagnosis.budget import EXPECTED, ErrorBudget
from ballfg.diagnosis.result import (
    Candidate,
    ContactResiduals,
    Diagnosis,
    Errors,
    Finding,
    FlightResiduals,
    GenericTest,
    MeasurementResiduals,
    Outcome,
    PredictedPath,
    Residuals,
    Unexplained,
    Value,
    Verdict,
)
from ballfg.dynamics import nominal_model

WIND, DRAG = 0.2, 0.12
SHOTS, BINS, SAMPLES = 50, 8, 60


def _states(generator: np.random.Generator, count: int, per_shot: int) -> tuple[NDArray[np.int64], Array, Array]:
    """Shots along x at 4 to 8 m/s: number of the shot, time and state of each row."""
    stretch = np.repeat(np.arange(count), per_shot)
    times = np.tile(np.linspace(0.02, 0.78, per_shot), count)
    speed = np.repeat(generator.uniform(4.0, 8.0, count), per_shot)
    spin = np.repeat(generator.normal(0.0, 60.0, (count, 3)), per_shot, axis=0)
    velocity = np.stack((speed * np.exp(-0.5 * times), 0.1 * speed, 2.5 - 9.0 * np.abs(times - 0.4)), axis=-1)
    position = np.stack((speed * times, 0.1 * speed * times, 0.25 + 0.3 * np.sin(math.pi * times)), axis=-1)
    return stretch, times, np.concatenate((position, velocity, spin), axis=-1)


def residuals(wind: float, seed: int, count: int = SHOTS) -> Residuals:
    """What a wind along x leaves that is not in the model, with noise."""
    generator = np.random.default_rng(seed)
    stretch, times, states = _states(generator, count, BINS)
    velocity = states[:, 3:6]
    speed = np.linalg.norm(velocity, axis=-1, keepdims=True)
    lacking = DRAG * wind * (speed * np.array([1.0, 0.0, 0.0]) + velocity[:, :1] / speed * velocity)
    noise = 0.25
    flight = FlightResiduals(
        stretch,
        times,
        states,
        lacking + generator.normal(0.0, noise, lacking.shape),
        np.broadcast_to(noise**2 * np.eye(3), (len(times), 3, 3)),
    )
    numbers, _, incoming = _states(generator, count, 1)
    incoming[:, 5] = -generator.uniform(1.5, 4.0, count)
    kick = np.diag([0.03, 0.03, 0.02, 5.0, 5.0, 5.0]) ** 2
    drawn = generator.multivariate_normal(np.zeros(6), kick, count)
    contact = ContactResiduals(
        numbers,
        np.zeros(count, dtype=np.int64),
        np.full(count, 0.45),
        incoming,
        drawn[:, :3],
        drawn[:, 3:],
        np.broadcast_to(kick, (count, 6, 6)),
    )
    stretch, times, states = _states(generator, count, SAMPLES)
    pattern = 0.012 * wind * np.cos(8.0 * times)[:, None] * np.array([1.0, 0.1, 0.0])
    sigma = np.full((len(times), 3), 0.003)
    measured = MeasurementResiduals(
        stretch,
        times,
        states,
        np.where(times > 0.45, times - 0.45, np.nan),
        pattern + generator.normal(0.0, sigma),
        sigma,
    )
    return Residuals(tuple(f"shot {i}" for i in range(count)), flight, contact, measured)


def errors(size: float, seed: int) -> Errors:
    """Errors of 25 tracks about a size in mm."""
    by_track = size * np.random.default_rng(seed).lognormal(-0.08, 0.4, 25)
    pooled = float(np.sqrt((by_track**2).mean()))
    paths = tuple(_path(f"shot {i}", 1e-3 * error) for i, error in enumerate(by_track))
    return Errors(pooled, 0.6 * pooled, (pooled / 8.0) ** 2, 3.9 - 0.02 * pooled, by_track, 0.87, 2.6, paths)


def _path(name: str, error: float) -> PredictedPath:
    """A flight along x whose prediction is off by `error` m to the left."""
    times = np.linspace(0.0, 0.6, 40)
    places = np.stack((5.0 * times, 0.2 * times, 1.0 + 2.0 * times - 4.9 * times**2), axis=-1)
    rest = places[16:]
    return PredictedPath(name, places[:16], times[16:] - times[15], rest + np.array([0.0, error, 0.0]), rest)


def _candidate(
    name: str, kind: str, explained: float, outcome: Outcome, bic: float | None = None, **estimate: Value
) -> Candidate:
    p = min(1.0, 26.0 * math.exp(-0.5 * explained))
    return Candidate(name, kind, estimate, explained, p, bic, outcome)


def rounds() -> tuple[tuple[Candidate, ...], ...]:
    """Two rounds: the wind is added in the first; in the second nothing is needed."""
    wind = {axis: Value(v, 0.012, "m/s") for axis, v in zip("xyz", (0.2, 0.004, -0.01), strict=True)}
    first = (
        _candidate("wind", "flight", 612.0, Outcome.ADDED, -598.3, **wind),
        _candidate("gust_region", "flight", 585.0, Outcome.ALIKE, -590.1, x=Value(0.31, 0.02, "m/s")),
        _candidate("drag_speed", "flight", 212.0, Outcome.WEAKER, -180.0, slope=Value(-0.021, 0.002, "s/m")),
        _candidate("time_scale", "measurement", 95.0, Outcome.WEAKER, share=Value(0.0021, 0.0002, "1")),
        _candidate("frame_tilt", "measurement", 40.0, Outcome.WEAKER, x=Value(0.0011, 0.0002, "rad")),
        _candidate("magnus_saturation", "flight", 9.0, Outcome.WEAKER, slope=Value(-0.1, 0.04, "1")),
        _candidate("table_tilt", "bounce", 3.4, Outcome.WEAKER, x=Value(0.0004, 0.0003, "rad")),
        _candidate("spin_decay", "flight", 0.8, Outcome.WEAKER, rate=Value(0.05, 0.07, "1/s")),
        _candidate("restitution_speed", "bounce", 0.5, Outcome.WEAKER, slope=Value(0.001, 0.002, "s/m")),
        _candidate("spin_label_scale", "measurement", 0.0, Outcome.INVISIBLE),
        _candidate("wind_shear", "flight", 0.02, Outcome.INVISIBLE, x=Value(0.1, 9.0, "1/s")),
    )
    second = tuple(
        replace(c, explained=0.004 * c.explained + 1.1, p_value=1.0, delta_bic=None, outcome=Outcome.NOT_NEEDED)
        if c.outcome is not Outcome.INVISIBLE
        else c
        for c in first[1:]
    )
    return first, second


def budget(before: float, after: float) -> ErrorBudget:
    """Parts of errors of 10 to 20 mm, mm; the floor is 9.0 mm."""
    squares = dict(zip(EXPECTED, (16.0, 9.0, 2.0, 0.0, 25.0, 15.0, 14.0), strict=True))
    return ErrorBudget.of(squares, 24, before, after)


def found() -> Diagnosis:
    """A wind, found."""
    model, before, after = nominal_model(), errors(20.0, 1), errors(10.0, 2)
    finding = Finding(
        name="wind",
        kind="flight",
        sentence="The air moves at one velocity everywhere; a rolling camera frame looks the same.",
        decide="Shoot in the opposite direction, or across: the wind keeps its direction in the room.",
        parameters=rounds()[0][0].estimate,
        p_value=3e-131,
        delta_bic=-598.3,
        indistinguishable_from=("gust_region",),
        held_out_gain=5.8,
        held_out_p=2e-7,
        probability=0.998,
        evidence=102.4,
    )
    left = tuple(
        GenericTest(name, where, p, share)
        for name, where, p, share in (
            ("flight", "no dependence on speed, height, spin, place or time", 0.41, 0.02),
            ("contact", "no dependence on speed, slip or place", 0.77, 0.0),
            ("measurement", "no dependence on time, place or speed", 0.36, 0.01),
            ("time", "neighbouring residuals are independent", 0.58, 0.0),
        )
    )
    return Diagnosis(
        dataset="shots <in a draught>",
        verdict=Verdict.FOUND,
        sentence="The model lacks wind: 0.20 m/s along x. With it the prediction error falls from 20.1 to 10.2 mm.",
        findings=(finding,),
        rounds=rounds(),
        before=before,
        after=replace(after, apex_rmse_mm=math.nan),
        tracks_found_on=25,
        tracks_judged_on=25,
        calibrated={
            "flight.drag.k": Value(0.1213, 0.0011, "1/m", 0.12),
            "flight.magnus.k": Value(0.00284, 0.00003, "1", 0.0028),
            "bounce.restitution.e": Value(0.9312, 0.0021, "1", 0.93),
        },
        noise={axis: Value(0.0031, 0.00002, "m", 0.003) for axis in "xyz"},
        unexplained=Unexplained("", 0.02, left, None),
        model=model,
        residuals_before=residuals(WIND, 3),
        residuals_after=residuals(0.0, 4),
        excluded=("shot 7 has no free flight of 10 samples.",),
        budget=budget(before.prediction_rmse_mm, after.prediction_rmse_mm),
    )


def silent() -> Diagnosis:
    """Nothing lacks; a data set without any contact."""
    left = residuals(0.0, 4)
    contact = left.contact
    none = ContactResiduals(**{name: getattr(contact, name)[:0] for name in ContactResiduals.__dataclass_fields__})
    same = replace(left, contact=none)
    quiet = tuple(replace(c, outcome=Outcome.NOT_NEEDED, delta_bic=None, p_value=1.0) for c in rounds()[1])
    return replace(
        found(),
        verdict=Verdict.NOTHING,
        sentence="Nothing is lacking: what the model leaves is noise.",
        findings=(),
        rounds=(quiet,),
        after=found().before,
        budget=None,
        residuals_before=same,
        residuals_after=same,
        excluded=(),
    )


def unexplained() -> Diagnosis:
    """Something is there that has no name; generic terms explain most of it."""
    from ballfg.diagnosis.result import Fallback

    tests = (GenericTest("flight", "along the flight, grows with time since launch, 0.3 m/s²", 2e-40, 0.8),)
    where = "In flight, along the motion: an acceleration of 0.3 m/s² that grows with the time since launch."
    fallback = Fallback("sparse terms", "0.31 t |v| v", errors(20.0, 1), errors(12.0, 5), nominal_model())
    return replace(
        found(),
        verdict=Verdict.UNEXPLAINED,
        sentence="Something is lacking that no candidate explains: an acceleration along the flight of 0.3 m/s².",
        findings=(),
        rounds=(rounds()[1],),
        after=found().before,
        residuals_after=residuals(WIND, 3),
        unexplained=Unexplained(where, 0.8, tests, fallback),
    )
