"""Chooses between the nominal, the calibrated and richer models by tracks that they were not fitted to.

All fitted tracks calibrate every candidate; then each fifth of them is judged by the population of the others, by
forecasts from three times: one alone decides by whether a bounce lies ahead of it. Every candidate is calibrated and
judged with the noise that the tracks show. A richer model must beat the best simpler one in the mean log score by more
than its standard error over the tracks; calibration is left out only where it surely gains nothing; docs/train.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import aligned
from ballfg.dynamics import AnalyticModel
from ballfg.estimation import Settings
from ballfg.estimation.noise.estimate import NoiseEstimate
from ballfg.learning.calibration import calibrate
from ballfg.learning.calibration.forecasts import moments
from ballfg.learning.calibration.groups import OWN, Groups
from ballfg.learning.calibration.predicting import FOLDS, LEAST, Predicted, best_predicting, predicted
from ballfg.learning.calibration.problem import Linear, Problem, Step, judged, population_model, population_settings
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.evaluation import Plain, TrackScore, summary
from ballfg.progress import Watch, unwatched

NOMINAL: Final = "nominal"
PER_TRACK: Final = "per-track coefficients"
CALIBRATED: Final = "calibrated"
GROUPED: Final = "with groups"
CORRECTED: Final = "with correction"
CANDIDATES: Final = (NOMINAL, PER_TRACK, CALIBRATED, GROUPED, CORRECTED)  # Simple ones first
UNLEARNED: Final = (NOMINAL, PER_TRACK)  # Without calibration: coefficients as they are, or estimated with each track
SURELY: Final = 1.0
"""Standard errors by which a richer model must gain. Two leave out models that pay where tracks are few; one misleads
in one of forty nominal worlds, where a correction gains just `NOTICED`. For calibration, they are to be shown
against it: its priors and its population contain the simpler models, and it costs 0.001 in those worlds."""
NOTICED: Final = 0.005
"""Least gain in the mean log density of a coordinate: half a per cent, which no user of a prediction notices."""
NEAR: Final = 0.3
"""s, longest judged forecast, as for the noise (`estimate_noise`): later on, contacts decide more than the air."""


@dataclass(frozen=True)
class Fitted:
    """A candidate, calibrated on all fitted tracks: its problem, without judging tracks, and all its steps."""

    problem: Problem
    steps: tuple[Step, ...]


class Candidate(Plain):
    """One candidate's predictions of the tracks that did not calibrate it."""

    name: str
    tracks: int
    rmse_median: float  # m, over forecasts
    coverage_90: float  # Share of measured coordinates inside their 90 % intervals
    log_score: float  # Mean over tracks, per coordinate and metre
    gain: float  # Mean difference from the best simpler candidate; 0 for the first
    gain_error: float | None  # Standard error of the gain over tracks; None: unknown, of one track

    @property
    def gained(self) -> str:
        """The gain with its standard error."""
        return f"{self.gain:+z.3f} ± {'unknown' if self.gain_error is None else f'{self.gain_error:.3f}'}"


class Choice(Plain):
    """The comparison of all candidates, and the name of the chosen one."""

    chosen: str
    candidates: tuple[Candidate, ...]

    def table(self) -> str:
        """The candidates as plain text."""
        rows = [("model", "tracks", "median RMSE, mm", "90 % hold, %", "log score", "gain over the best simpler")]
        for one in self.candidates:
            gain = "" if one is self.candidates[0] else one.gained
            numbers = (f"{1e3 * one.rmse_median:.1f}", f"{100 * one.coverage_90:.0f}", f"{one.log_score:.3f}")
            rows.append((one.name, str(one.tracks), *numbers, gain))
        return "\n".join(aligned(rows))

    def verdict(self) -> str:
        """A sentence on the choice."""
        if self.chosen in UNLEARNED:
            return "No model surely beats the nominal one on the tracks that it was not fitted to."
        return f"Chosen: {self.chosen}, the simplest model that none surely beats."


def check_enough(fitted: Sequence[str]) -> None:
    """Refuses fewer fitted tracks than a choice needs. Raises: ValueError."""
    if len(fitted) < LEAST:
        raise ValueError(f"kind: auto needs {LEAST} tracks to fit; got {len(fitted)}. Add some, or write calibrate.")


def choose_candidate(problem: Problem, watch: Watch = unwatched) -> tuple[Choice, dict[str, Fitted]]:
    """Compare the candidates within the fitted tracks of a problem.

    Returns: the comparison, and the calibrated candidates by name; those whose estimates fail are left out.
    Raises: ValueError: too few tracks.
    """
    fitted = problem.split.fit
    check_enough(fitted)
    problem = replace(problem, split=replace(problem.split, judge=()))
    plain = replace(problem, config=config_of(problem.config, CALIBRATED), groups=None)
    config = config_of(problem.config, GROUPED)
    assert config.groups is not None
    grouped = replace(plain, config=config, groups=Groups.of(problem.dataset, config.groups, fitted))

    found: dict[str, Fitted] = {}
    scores: dict[str, Sequence[TrackScore | None]] = {}
    known = replace(problem, settings=replace(problem.settings, coefficients={}))
    for name, posed in ((NOMINAL, known), (PER_TRACK, problem)):
        noise = calibrate.fitted_noise(posed, problem.model, posed.settings, watch, errors=False)
        settings = posed.settings if noise is None else noise.settings
        scores[name] = _judged(posed, [(problem.model, settings)], watch)
    shown = None if noise is None else noise.noise
    for name, posed in ((CALIBRATED, plain), (GROUPED, grouped), (CORRECTED, grouped)):
        try:
            if name == CORRECTED:
                posed = calibrate.pose_correction(grouped, found[GROUPED].steps[-1], watch, noise)
            else:
                posed = replace(posed, shown=shown)
            found[name], linear = _fitted(posed, watch)
        except calibrate.TooManyFailures:  # it, and the richer ones that begin from it, are left out
            break
        last = found[name].steps[-1]
        model, settings = population_model(posed, last), population_settings(posed, last)
        noise = calibrate.fitted_noise(posed, model, settings, watch, errors=False)
        predictions = predicted(posed, last, settings if noise is None else noise.settings, watch)
        scores[name] = _folds(found[name], predictions, linear, noise, watch)
    return compared(scores), found


def _fitted(problem: Problem, watch: Watch) -> tuple[Fitted, Linear]:
    """A calibration on all fitted tracks, and these tracks as linearised about its last step but one."""
    steps = [calibrate.first_step(problem)]
    while True:
        linear = calibrate.linearised(problem, steps[-1], watch)
        steps.append(calibrate.advanced(problem, steps[-1], linear))
        if calibrate.has_ended(problem.config, steps[-1]):
            return Fitted(problem, tuple(steps)), linear


def _folds(
    fitted: Fitted, predictions: Predicted, linear: Linear, noise: NoiseEstimate | None, watch: Watch
) -> tuple[TrackScore | None, ...]:
    """Scores of the fitted tracks' forecasts, each by the population of the other folds, with the noise of all."""
    problem, names = fitted.problem, fitted.problem.split.fit
    made: list[tuple[AnalyticModel, Settings]] = []
    for k in range(min(FOLDS, len(names))):
        out = names[k::FOLDS]
        step = calibrate.advanced(problem, fitted.steps[-2], linear.without(out))
        step = best_predicting(step, predictions, out)
        settings = population_settings(problem, step)
        settings = settings if noise is None else calibrate.about_population(noise, settings).settings
        made.append((population_model(problem, step), settings))
    return _judged(problem, made, watch)


def _judged(
    problem: Problem, made: Sequence[tuple[AnalyticModel, Settings]], watch: Watch
) -> tuple[TrackScore | None, ...]:
    """Scores of the fitted tracks' forecasts: from the config's share of each, and half-way before and after it."""
    shares = moments(problem.config.observed_share)
    return judged(problem, made, problem.split.fit, shares, min(NEAR, problem.horizon), watch)


def config_of(config: CalibrationConfig, chosen: str) -> CalibrationConfig:
    """The config that calibrates a chosen candidate."""
    grouped = chosen in (GROUPED, CORRECTED)
    found = {"groups": (config.groups or OWN) if grouped else None, "correction": chosen == CORRECTED}
    return config.model_copy(update={"kind": "calibrate"} | found)


def compared(scores: dict[str, Sequence[TrackScore | None]]) -> Choice:
    """The choice by the forecasts that every candidate could be judged on; those of a track count as one.

    Args: scores: of the same forecasts in the same order, by candidate, simple ones first; None: not judged.
    Raises: ValueError: if no forecast was judged by every one.
    """
    rows = [row for row in zip(*scores.values(), strict=True) if all(row)]
    kept = {name: [one for row in rows if (one := row[k]) is not None] for k, name in enumerate(scores)}
    logs = {name: _by_track(found) for name, found in kept.items()}
    chosen, candidates = next(iter(scores)), list[Candidate]()
    for name in scores:
        found = summary(kept[name])
        if found is None:
            raise ValueError("tracks must be judged by every candidate; none was. Look at them with ballfg show.")
        own, gains, count = logs[name], logs[name] - logs[chosen], len(logs[name])
        gain, error = float(gains.mean()), float(gains.std(ddof=1) / np.sqrt(count)) if count > 1 else None
        numbers = {"rmse_median": found.rmse_median, "coverage_90": found.coverage_90, "log_score": float(own.mean())}
        candidates.append(Candidate(name=name, tracks=count, gain=gain, gain_error=error, **numbers))
        if name == CALIBRATED:
            better = gain + SURELY * (error or 0.0) > NOTICED
        else:  # one track alone tells nothing about others: no richer model surely gains on it
            better = error is not None and gain > max(SURELY * error, NOTICED)
        chosen = name if better else chosen
    return Choice(chosen=chosen, candidates=tuple(candidates))


def _by_track(scores: Sequence[TrackScore]) -> Array:
    """(n,) mean log score of each of n tracks."""
    tracks = dict[str, list[float]]()
    for one in scores:
        tracks.setdefault(one.name, []).append(one.log_score)
    return np.array([np.mean(logs) for logs in tracks.values()])
