"""Maps the estimated numbers of the noise to a vector of logarithms with a prior, and back to settings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.measurement.position_noise import FACTOR_FOUR
from ballfg.estimation.noise.linear_filter import Noise
from ballfg.estimation.noise.linear_tracks import LinearTracks
from ballfg.estimation.settings import Settings
from ballfg.factors.noise import PROCESS_NOISE
from ballfg.tracks.noise import TrackNoise


@dataclass(frozen=True)
class Parameter:
    """One number of the noise.

    Attributes:
        name: a field of `TrackNoise`.
        axis: 0, 1, 2 for x, y, z, or the place of a coefficient; None for one number for all.
        start: its prior median, in its own unit.
        spread: prior standard deviation of its logarithm.
        low, high: limits, in its own unit.
    """

    name: str
    axis: int | None
    start: float
    spread: float
    low: float
    high: float


FACTOR_TWO: Final = 0.7
"""Standard deviation of a logarithm when a number is known to a factor of two."""
MEMORY_SHARE: Final = 0.4
"""Prior median of the lasting part, as a share of the white part."""
USUAL_JITTER: Final = 1e-4
"""s. Stamps of a driver are good to a tenth of a millisecond, arrival times to one."""
COEFFICIENTS: Final = "coefficients"


def parameters_of(
    settings: Settings, tracks: LinearTracks, position_known: bool, tracker_known: bool = False
) -> list[Parameter]:
    """The numbers that some tracks can determine.

    Args:
        settings: prior medians.
        tracks: without labels, balls without a label, or bounces, they do not determine those numbers.
        position_known: True if the white noise of positions is stated and fixed.
        tracker_known: True if the memory of the tracker and the jitter of the stamps are, too.
    """
    process, found = settings.process, []
    white = settings.position_scale * np.array(settings.position_noise)
    for axis in range(3):
        if not position_known:
            found.append(Parameter("position", axis, white[axis], FACTOR_FOUR, 1e-5, 0.1))
    if not tracker_known:
        for axis in range(3):
            memory = settings.memory[axis] or MEMORY_SHARE * white[axis]
            found.append(Parameter("memory", axis, memory, FACTOR_FOUR, 1e-5, 0.1))
        found.append(Parameter("memory_time", None, settings.memory_time, FACTOR_FOUR, 0.002, 0.5))
        found.append(Parameter("stamp_jitter", None, settings.stamp_jitter or USUAL_JITTER, FACTOR_FOUR, 1e-6, 0.01))
    found.append(Parameter("acceleration", None, process.acceleration, FACTOR_FOUR, 0.003, 10.0))
    if bool((tracks.kicks[:, :, PROCESS_NOISE.index("contact_velocity")] != 0.0).any()):
        tangential = process.contact_tangential or process.contact_velocity
        found.append(Parameter("contact_velocity", None, process.contact_velocity, FACTOR_FOUR, 1e-3, 2.0))
        found.append(Parameter("contact_tangential", None, tangential, FACTOR_FOUR, 1e-3, 3.0))
        found.append(Parameter("contact_spin", None, process.contact_spin, FACTOR_FOUR, 0.5, 300.0))
    if bool(tracks.labelled.any()):
        label = settings.spin_label_noise if settings.launcher is None else settings.launcher.sigma
        unit = float(tracks.label_spreads[0])
        found.append(Parameter("spin_label", None, label, FACTOR_FOUR, 1.0 / unit, 300.0 / unit))
    if not bool((tracks.labelled | ~np.isnan(tracks.group_sigmas).any(axis=1)).all()):
        found.append(Parameter("spin_prior", None, settings.spin_prior, FACTOR_FOUR, 3.0, 500.0))
    # each has its own multiple: short parts show how much drags differ, and nothing of bounces that are still to come
    found += [Parameter(COEFFICIENTS, place, 1.0, FACTOR_TWO, 0.03, 5.0) for place in range(len(settings.coefficients))]
    return found


def noise_of(parameters: list[Parameter], logs: Array, settings: Settings) -> Noise:
    """The noise for logarithms (r, k), with a row for each track or one for all.

    All other numbers are the settings'.
    """
    values = {(p.name, p.axis): value for p, value in zip(parameters, np.exp(logs).T, strict=True)}

    def one(name: str, otherwise: float, axis: int | None = None) -> Array:
        return values.get((name, axis), np.full(len(logs), otherwise))

    white = settings.position_scale * np.array(settings.position_noise)
    process = [one(name, getattr(settings.process, name)) for name in PROCESS_NOISE]
    return Noise(
        position=np.stack([one("position", white[a], a) / white[a] for a in range(3)], axis=-1),
        memory=np.stack([one("memory", settings.memory[a], a) for a in range(3)], axis=-1) ** 2,
        memory_time=one("memory_time", settings.memory_time),
        stamp_jitter=one("stamp_jitter", settings.stamp_jitter) ** 2,
        process=np.stack(process, axis=-1),
        spin_label=one("spin_label", settings.spin_label_noise),
        spin_prior=one("spin_prior", settings.spin_prior),
        coefficients=np.stack([one(COEFFICIENTS, 1.0, place) for place in _places(parameters)], axis=-1),
    )


def by_logs(parameters: list[Parameter], noise: Noise, slopes: Noise) -> Array:
    """(t, k) derivatives by the logarithms of `noise_of`, from those by the noise (t, ...)."""
    found, places = [], _places(parameters)
    for p in parameters:
        power, at = 2.0 if p.name in ("memory", "stamp_jitter") else 1.0, p.axis
        name = p.name
        if name in PROCESS_NOISE:
            name, at = "process", PROCESS_NOISE.index(name)
        elif name == COEFFICIENTS:
            at = places.index(at)
        value, slope = getattr(noise, name), getattr(slopes, name)
        found.append(power * (value * slope if at is None else value[:, at] * slope[:, at]))
    return np.stack(found, axis=1)


def _places(parameters: list[Parameter]) -> list[int | None]:
    """The places of the estimated coefficients; None for a multiple of all."""
    return [p.axis for p in parameters if p.name == COEFFICIENTS] or [None]


def track_noise(parameters: list[Parameter], logs: Array, settings: Settings) -> TrackNoise:
    """The noise for a vector of logarithms (k,), in the form of a file."""
    values: dict[str, object] = {}
    for name in dict.fromkeys(p.name for p in parameters if p.name != COEFFICIENTS):
        numbers = [float(np.exp(log)) for p, log in zip(parameters, logs, strict=True) if p.name == name]
        values[name] = tuple(numbers) if len(numbers) == 3 else numbers[0]
    factors = coefficient_factors(parameters, logs, settings)
    spreads = {name: factors[name] * sigma for name, sigma in settings.coefficients.items()}
    return TrackNoise(**values, coefficients=spreads)  # type: ignore[arg-type]


def coefficient_factors(parameters: list[Parameter], logs: Array, settings: Settings) -> dict[str, float]:
    """The spread of each coefficient for logarithms (k,), as a multiple of the settings'; 1 if it is not estimated."""
    found = {p.axis: float(np.exp(log)) for p, log in zip(parameters, logs, strict=True) if p.name == COEFFICIENTS}
    return {name: found.get(place, 1.0) for place, name in enumerate(settings.coefficients)}


def with_medians(settings: Settings, usual: Settings, *, position_known: bool) -> Settings:
    """Settings with the usual noise, as the prior medians of all but the coefficients.

    Args: position_known: True to keep the white noise of positions.
    """
    names = ["memory", "memory_time", "stamp_jitter", "spin_label_noise", "spin_prior", "process"]
    names += [] if position_known else ["position_noise", "position_scale"]
    return replace(settings, **{name: getattr(usual, name) for name in names})


def with_noise(settings: Settings, noise: TrackNoise) -> Settings:
    """Settings with a noise.

    Spreads of coefficients replace those of the settings for coefficients that are estimated with each track; if the
    settings estimate none, all coefficients of the noise are estimated.
    """
    own: dict[str, Any] = {
        "position_noise": noise.position,
        "memory": noise.memory,
        "memory_time": noise.memory_time,
        "stamp_jitter": noise.stamp_jitter,
        "spin_label_noise": noise.spin_label,
        "spin_prior": noise.spin_prior,
    }
    process = {name: value for name in PROCESS_NOISE if (value := getattr(noise, name, None)) is not None}
    coefficients = {name: noise.coefficients.get(name, sigma) for name, sigma in settings.coefficients.items()}
    launcher = settings.launcher
    if launcher is not None and noise.spin_label is not None:
        launcher = replace(launcher, sigma=noise.spin_label)
    return replace(
        settings,
        **{name: value for name, value in own.items() if value is not None},
        position_scale=settings.position_scale if noise.position is None else 1.0,
        launcher=launcher,
        process=replace(settings.process, **process),
        coefficients=coefficients or dict(noise.coefficients),
    )
