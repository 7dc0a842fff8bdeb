"""Chooses between the nominal, the calibrated and richer models by tracks that they were not fitted to.

Both halves of the fitted tracks calibrate every candidate once, and the other half judges it. A richer model must beat
the best simpler one in the mean log score by more than twice its standard error over the tracks; docs/train.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from pydantic import BaseModel, ConfigDict

from ballfg.arrays import Array
from ballfg.dynamics import AnalyticModel
from ballfg.estimation import Settings
from ballfg.estimation.noise.estimate import NoiseEstimate
from ballfg.learning.calibration.calibrate import (
    Problem,
    calibrate,
    fitted_noise,
    population_model,
    population_settings,
    pose_correction,
    score,
)
from ballfg.learning.calibration.groups import OWN, Groups
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.evaluation import Summary, TrackScore, summary
from ballfg.progress import Watch, unwatched

NOMINAL: Final = "nominal"
CALIBRATED: Final = "calibrated"
GROUPED: Final = "with groups"
CORRECTED: Final = "with correction"
CANDIDATES: Final = (NOMINAL, CALIBRATED, GROUPED, CORRECTED)
"""Simple ones first."""
SURELY: Final = 2.0
"""Standard errors by which a richer model must gain: of forty nominal worlds chance then misleads in one or two."""
NOTICED: Final = 0.005
"""Least gain in the mean log density of a coordinate: half a per cent, which no user of a prediction notices."""
LEAST: Final = 4
"""Fitted tracks that a choice needs, two in each half."""


class Candidate(BaseModel):
    """One candidate's predictions of the tracks that did not calibrate it."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)

    name: str
    tracks: int
    rmse_median: float
    """m."""
    coverage_90: float
    """Share of measured coordinates inside their 90 % intervals."""
    log_score: float
    """Mean over tracks, per coordinate and metre."""
    gain: float
    """Mean difference from the best simpler candidate; 0 for the first."""
    gain_error: float
    """Standard error of the gain over tracks."""


class Choice(BaseModel):
    """The comparison of all candidates, and the name of the chosen one."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)

    chosen: str
    candidates: tuple[Candidate, ...]

    def table(self) -> str:
        """The candidates as plain text."""
        rows = [("model", "tracks", "median RMSE, mm", "90 % hold, %", "log score", "gain over the best simpler")]
        for one in self.candidates:
            gain = "" if one.name == NOMINAL else f"{one.gain:+.3f} ± {one.gain_error:.3f}"
            numbers = (f"{1e3 * one.rmse_median:.1f}", f"{100 * one.coverage_90:.0f}", f"{one.log_score:.3f}")
            rows.append((one.name, str(one.tracks), *numbers, gain))
        widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
        lines = ("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows)
        return "\n".join(line.rstrip() for line in lines)

    def verdict(self) -> str:
        """A sentence on the choice."""
        if self.chosen == NOMINAL:
            return "No model surely beats the nominal one on the tracks that it was not fitted to."
        return f"Chosen: {self.chosen}, the simplest model that none surely beats."


def choose_candidate(problem: Problem, watch: Watch = unwatched) -> Choice:
    """Compare the candidates within the fitted tracks of a problem.

    Raises: ValueError: too few tracks. TooManyFailures: as `calibrate`.
    """
    fitted = problem.split.fit
    if len(fitted) < LEAST:
        raise ValueError(f"kind: auto needs {LEAST} tracks to fit; got {len(fitted)}. Add some, or write calibrate.")
    scores: dict[str, list[TrackScore | None]] = {name: [] for name in CANDIDATES}
    for fit, judge in ((fitted[::2], fitted[1::2]), (fitted[1::2], fitted[::2])):
        for name, found in _fold(problem, fit, judge, watch).items():
            scores[name] += found
    return compared(scores)


def config_of(config: CalibrationConfig, chosen: str) -> CalibrationConfig:
    """The config that calibrates a chosen candidate."""
    grouped = chosen in (GROUPED, CORRECTED)
    found = {"groups": (config.groups or OWN) if grouped else None, "correction": chosen == CORRECTED}
    return config.model_copy(update={"kind": "calibrate"} | found)


def _fold(
    problem: Problem, fit: Sequence[str], judge: Sequence[str], watch: Watch
) -> dict[str, tuple[TrackScore | None, ...]]:
    """Scores of some judging tracks by every candidate, calibrated on others."""
    split = replace(problem.split, fit=tuple(fit), judge=())
    plain = replace(problem, split=split, config=config_of(problem.config, CALIBRATED), groups=None)
    config = config_of(problem.config, GROUPED)
    assert config.groups is not None
    grouped = replace(plain, config=config, groups=Groups.of(problem.dataset, config.groups, split.fit))
    judging = replace(plain, split=replace(split, judge=tuple(judge)))

    found: dict[str, tuple[TrackScore | None, ...]] = {}

    def judged(name: str, posed: Problem, model: AnalyticModel, settings: Settings) -> NoiseEstimate | None:
        noise = fitted_noise(posed, model, settings, watch, errors=False)
        found[name] = score(judging, model, watch, settings if noise is None else noise.settings)
        return noise

    judged(NOMINAL, plain, problem.model, problem.settings)
    last, noise = None, None
    for name, posed in ((CALIBRATED, plain), (GROUPED, grouped), (CORRECTED, grouped)):
        if name == CORRECTED:
            assert last is not None
            posed = pose_correction(grouped, last, watch, noise)
        *_, last = calibrate(posed, watch=watch)
        noise = judged(name, posed, population_model(posed, last), population_settings(posed, last))
    return found


def compared(scores: dict[str, list[TrackScore | None]]) -> Choice:
    """The choice by the tracks that every candidate could be judged on.

    Args: scores: of the same tracks in the same order, by name of the candidate, simple ones first; None: not judged.
    Raises: ValueError: if no track was judged by every one.
    """
    rows = [row for row in zip(*scores.values(), strict=True) if all(row)]
    kept = {name: [row[k] for row in rows if row[k] is not None] for k, name in enumerate(scores)}
    logs = {name: np.array([one.log_score for one in kept[name] if one is not None]) for name in scores}
    chosen, candidates = NOMINAL, []
    for name in scores:
        found = summary([one for one in kept[name] if one is not None])
        if found is None:
            raise ValueError("tracks must be judged by every candidate; none was. Look at them with ballfg show.")
        gain, error = _gain(logs[name] - logs[chosen])
        candidates.append(_candidate(name, found, logs[name], gain, error))
        if gain > max(SURELY * error, NOTICED):
            chosen = name
    return Choice(chosen=chosen, candidates=tuple(candidates))


def _gain(differences: Array) -> tuple[float, float]:
    """Mean and its standard error."""
    count = len(differences)
    return float(differences.mean()), float(differences.std(ddof=1) / np.sqrt(count)) if count > 1 else 0.0


def _candidate(name: str, found: Summary, logs: Array, gain: float, error: float) -> Candidate:
    numbers = {"rmse_median": found.rmse_median, "coverage_90": found.coverage_90, "log_score": float(logs.mean())}
    return Candidate(name=name, tracks=found.tracks, gain=gain, gain_error=error, **numbers)
