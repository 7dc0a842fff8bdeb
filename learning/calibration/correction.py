"""Learns a correction of drag, lift and restitution after a calibration: further coefficients of the same population.

The weights of the effect `air_correction` are shared by all tracks; their prior's width is the one of largest evidence.
The restitution has a slope over the impact's speed: without it, what later bounces lack would be the air's to explain.
The calibrated model and its spins are where the iteration begins.
"""

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final, cast

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.dynamics import AnalyticModel
from ballfg.dynamics.effect import Effect
from ballfg.dynamics.effects.bounce import Restitution, RestitutionSpeed
from ballfg.dynamics.effects.generic import (
    DOUBT,
    DOUBTS,
    FORCES,
    FUNCTIONS,
    WEIGHTS,
    AirCorrection,
    correction_terms,
)
from ballfg.estimation import Estimate, Status
from ballfg.learning.calibration.coefficients import Chosen, choose, values_of
from ballfg.learning.calibration.groups import GroupSpin
from ballfg.state import SPIN, VELOCITY

SECTION: Final = f"flight.{AirCorrection.name}"
DRAG: Final = tuple(f"{SECTION}.{name}" for name in WEIGHTS if name.startswith("drag"))  # Names of the weights of drag
ALL: Final = tuple(f"{SECTION}.{name}" for name in WEIGHTS)
"""With those of lift, which tracks without spin labels cannot tell from another spin."""
SCALE: Final = "flight.drag.k"
RESTITUTION: Final = f"bounce.{Restitution.name}.e"
SLOPE: Final = f"bounce.{RestitutionSpeed.name}.slope"
STEEP: Final = 0.01  # s/m. Prior standard deviation of the slope: some per cent of restitution between impacts
HELD: Final = 0.1  # Prior standard deviation of the mean drag beside a correction, as a share of the usual one
LINEAR: Final = 0.1
"""Standard deviation of each weight in one track, about the mean at which it is linearised; it is removed again."""
REACH: Final = (5.0, 95.0)  # Percentiles of the speeds and spin ratios of the samples that the functions span
BEYOND: Final = 2.0  # Scale of the functions as a multiple of half the span: the kernel's length
CONSTANT: Final = np.array([0.5**0.5 if name in ("vv", "ss") else float(name == "one") for name in FUNCTIONS])
"""Weights of a correction that is 1, but for terms of the fourth degree."""
LEAST_SPEED: Final = 1.0  # m/s. Least scale: over less, the drag law hardly changes
LEAST_RATIO: Final = 0.1  # Least scale of S / (1 + S) of the spin ratio S
MOST_RATIO: Final = 0.99  # Largest S / (1 + S) that is shown
ELSEWHERE: Final = 0.05  # Weight of places without data in the order of the directions of uncertainty


@dataclass(frozen=True)
class Correction:
    """Where a correction begins."""

    mean: Array  # (p,) of all coefficients, those of the calibration first
    spins: tuple[GroupSpin, ...]  # of each group, as calibrated
    terms: Array  # (11, 11) mean product of the functions over the samples

    def directions(self, chosen: Chosen, mean: Array, covariance: Array) -> tuple[tuple[float, ...], ...]:
        """Of the uncertainty of each force's weights, first of drag; those that move it most at the samples lead.

        Each force has its own, for one of them would take most of the leading ones that both shared. Those of drag are
        of the weights together with the mean drag, for a larger drag and a larger correction are the same.

        Args: mean, covariance: (p,), (p, p) of the chosen coefficients.
        """
        count, found = len(FUNCTIONS), list[tuple[float, ...]]()
        metric = self.terms + ELSEWHERE * np.eye(count)
        for first in range(0, len(chosen.alike), count):
            turn = np.eye(len(mean))[chosen.alike[first : first + count]]
            k = chosen.names.index(SCALE) if SCALE in chosen.names and first == 0 else None
            if k is not None and mean[k] > 0.0:
                turn[:, k] = CONSTANT / mean[k]
            values, vectors = np.linalg.eigh(turn @ covariance @ turn.T)
            root = vectors * np.sqrt(np.maximum(values, 0.0))
            _, turns = np.linalg.eigh(root.T @ metric @ root)
            found += [tuple(row) for row in (root @ turns[:, ::-1]).T.tolist()]
        return tuple(found)


def with_correction(
    model: AnalyticModel, estimates: Iterable[Estimate], *, labelled: bool
) -> tuple[AnalyticModel, Array]:
    """A copy of the model with a correction of zero, whose functions span the samples of some estimates.

    Where these bounce, a restitution gets a slope of zero about the median impact, if the model has none yet.

    Args: labelled: as for `with_weights`; without it, lift has no doubts.
    Returns: the model, and `Correction.terms`.
    Raises: ValueError: if the model has a correction or no drag or Magnus force, or no estimate converged.
    """
    if AirCorrection.name in model.flight:
        raise ValueError(f"model must not have {SECTION} yet; got one. Start from the model that it corrects.")
    found = [estimate for estimate in estimates if estimate.status is Status.OK]
    if not found:
        raise ValueError("tracks must have estimates; every one failed. Calibrate without a correction.")
    states = np.concatenate([estimate.states for estimate in found])
    speed = np.maximum(np.linalg.norm(states[:, VELOCITY], axis=1), LEAST_SPEED)
    rim = model.radius * np.linalg.norm(states[:, SPIN], axis=1)
    ratio = rim / (speed + rim)
    shape: dict[str, float] = {}
    places = []
    for name, values, least in (("speed", speed, LEAST_SPEED), ("ratio", ratio, LEAST_RATIO)):
        low, high = np.percentile(values, REACH)
        shape |= {name: float(low + high) / 2.0, f"{name}_scale": max(BEYOND * float(high - low) / 2.0, least)}
        places.append(torch.from_numpy((values - shape[name]) / shape[f"{name}_scale"])[:, None])
    terms = correction_terms(places[0], places[1]).numpy()
    effect = AirCorrection(**shape)
    carried = [f"{DOUBT[force]}_{k}" for force in FORCES[: 1 + labelled] for k in range(1, DOUBTS + 1)]
    effect.set_sigmas(**dict.fromkeys(WEIGHTS, LINEAR), **dict.fromkeys(carried, 1.0))
    effects = [*copy.deepcopy(model.effects), effect]
    falls = np.concatenate([estimate.falls for estimate in found])
    falls = falls[falls > 0.0]
    if len(falls) and Restitution.name in model.bounce and RestitutionSpeed.name not in model.bounce:
        slope = RestitutionSpeed(slope=0.0, reference=float(np.median(falls)))
        slope.set_sigmas(slope=STEEP)
        effects.append(slope)
    corrected = AnalyticModel(effects, radius=model.radius, inertia_factor=model.inertia_factor)
    return corrected, terms.T @ terms / len(terms)


def set_doubts(model: AnalyticModel, doubts: Sequence[Sequence[float]]) -> None:
    """Put the directions of the weights' uncertainty into a model with a correction; as of `Correction.directions`."""
    parameters = dict(model.named_parameters())
    with torch.no_grad():
        for number, direction in enumerate(doubts):
            force, k = FORCES[number // len(FUNCTIONS)], number % len(FUNCTIONS) + 1
            for term, value in zip(FUNCTIONS, direction, strict=True):
                parameters[f"{SECTION}.{force}_{term}_{k}"].fill_(value)


def learned(model: AnalyticModel, force: str, speed: Array, ratio: Array) -> tuple[Array, Array]:
    """The relative correction of a force, and its standard deviation.

    Args:
        model: with a correction.
        force: `drag` or `lift`.
        speed, ratio: (n,) m/s, and (n,) spin ratio, dimensionless.
    Returns: (n,) each, dimensionless.
    """
    values = cast(Effect, model.flight[AirCorrection.name]).values()
    x, y = (
        torch.from_numpy((given - values[name]) / values[f"{name}_scale"])[:, None]
        for name, given in (("speed", speed), ("ratio", ratio / (1.0 + ratio)))
    )
    terms = correction_terms(x, y).numpy()
    ends = ("", *(f"_{k}" for k in range(1, len(FUNCTIONS) + 1)))
    mean, *away = np.array([[values[f"{force}_{term}{end}"] for term in FUNCTIONS] for end in ends]) @ terms.T
    return mean, np.linalg.norm(away, axis=0)


def spans(model: AnalyticModel) -> dict[str, tuple[float, float]]:
    """Ends of the range of the samples, 5 to 95 %: of `speed`, m/s, and `ratio`; model: with a correction."""
    values = cast(Effect, model.flight[AirCorrection.name]).values()
    half = {name: values[f"{name}_scale"] / BEYOND for name in ("speed", "ratio")}
    found = {name: (max(values[name] - reach, 0.0), values[name] + reach) for name, reach in half.items()}
    low, high = (end / (1.0 - end) for end in np.minimum(found["ratio"], MOST_RATIO).tolist())
    return found | {"ratio": (low, high)}


def places(model: AnalyticModel) -> tuple[Array, Array]:
    """Speeds, m/s, and spin ratios to list a correction at: the middle of its samples and both ends of each.

    Args: model: with a correction.
    Returns: (5,) each.
    """
    values, ends = cast(Effect, model.flight[AirCorrection.name]).values(), spans(model)
    speed, ratio = values["speed"], values["ratio"] / (1.0 - values["ratio"])
    return np.array([speed, *ends["speed"], speed, speed]), np.array([ratio, ratio, ratio, *ends["ratio"]])


def doubt_sigmas(model: AnalyticModel) -> dict[str, float]:
    """Prior standard deviations of the doubts, by name; model: with a correction."""
    known = model.declared_coefficients()
    names = (f"{SECTION}.{prefix}_{k}" for prefix in DOUBT.values() for k in range(1, DOUBTS + 1))
    return {name: known[name].sigma for name in names if known[name].sigma > 0.0}


def with_weights(model: AnalyticModel, chosen: Chosen, *, labelled: bool) -> Chosen:
    """The chosen coefficients, with their priors, the slope of the restitution, and weights of the model's correction.

    Drag is held near its calibrated value: a larger one and a larger correction are the same.

    Args: labelled: True if tracks have spin labels, which tell a larger lift from a larger spin.
    """
    shared = ALL if labelled else DRAG
    slope = (SLOPE,) if SLOPE in model.declared_coefficients() and SLOPE not in chosen.names else ()
    further = choose(model, (*slope, *shared))
    if SCALE in chosen.names:
        k, start, sigma = chosen.names.index(SCALE), chosen.start.copy(), chosen.sigma.copy()
        start[k], sigma[k] = values_of(model, [SCALE])[0], HELD * sigma[k]
        chosen = replace(chosen, start=start, sigma=sigma)
    pairs = {name: (getattr(chosen, name), getattr(further, name)) for name in ("start", "sigma", "low", "high")}
    names, units = chosen.names + further.names, chosen.units + further.units
    return Chosen(
        names, units, **{name: np.concatenate(pair) for name, pair in pairs.items()}, shared=shared, steady=slope
    )
