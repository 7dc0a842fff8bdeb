"""Reports a calibration as `report.json` and as text: coefficients and errors before and after."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from ballfg.checks import aligned
from ballfg.estimation.noise.estimate import NoiseEstimate
from ballfg.learning.calibration.calibrate import has_converged
from ballfg.learning.calibration.correction import SCALE, learned, places
from ballfg.learning.calibration.problem import Problem, Step, population_model
from ballfg.learning.evaluation import Gain, Summary, TrackScore, gain_of, summary

AXES = ("forward", "across", "up")
NEW_INFORMATION = 0.05  # Least share by which informative data narrow the prior of a coefficient


@dataclass(frozen=True)
class Comparison:
    """Scores of those judging tracks that could be judged both before and after."""

    before: Summary | None
    after: Summary | None
    with_spread: Summary | None  # with the calibrated model, each track's prior as wide as the population
    with_noise: Summary | None  # with the noise besides that the fitted tracks show
    better: int  # number of tracks whose RMSE fell
    pairs: np.ndarray  # (n, 2) m, RMSE before and after of each track
    failed: int  # number of tracks that could not be judged each time
    written: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """(n,) m, RMSE of each track with the model that is written, with its population and noise."""
    density: tuple[float, float] | None = None  # as of `Gain`; None where the errors alone decide

    @property
    def gain(self) -> Gain | None:
        """The change of the errors: by the coefficients or, where that is for the worse, with population and noise.

        None with fewer than two tracks.
        """
        written = gain_of(self.pairs[: len(self.written), 0], self.written)
        plain = gain_of(self.pairs[:, 0], self.pairs[:, 1])
        if written is not None and written.word == "worse":
            return written
        return None if plain is None else replace(plain, density=self.density)


def compare(
    before: Sequence[TrackScore | None],
    after: Sequence[TrackScore | None],
    spread: Sequence[TrackScore | None],
    noise: Sequence[TrackScore | None],
) -> Comparison:
    """Compare scores of the same tracks in the same order."""
    rows = [(b, a, s, n) for b, a, s, n in zip(before, after, spread, noise, strict=True) if b and a and s and n]
    pairs = np.array([(b.rmse, a.rmse) for b, a, *_ in rows]).reshape(-1, 2)
    return Comparison(
        before=summary([b for b, *_ in rows]),
        after=summary([a for _, a, *_ in rows]),
        with_spread=summary([s for _, _, s, _ in rows]),
        with_noise=summary([n for *_, n in rows]),
        better=int((pairs[:, 1] < pairs[:, 0]).sum()),
        pairs=pairs,
        failed=len(before) - len(rows),
        written=np.array([n.rmse for *_, n in rows]),
    )


def outcome(comparison: Comparison) -> str:
    """Whether the calibrated model predicts better than before: better, no different, worse, or not known."""
    return "not known" if comparison.gain is None else comparison.gain.word


def report(problem: Problem, last: Step, comparison: Comparison, noise: NoiseEstimate | None) -> dict[str, Any]:
    """The content of `report.json`, without times and paths: the same run writes the same bytes."""
    shown = None if noise is None else {**noise.noise.to_mapping(), "relative_errors": noise.relative_errors}
    return {
        "dataset": problem.dataset.info.name,
        "converged": has_converged(problem.config, last),
        "iterations": last.number,
        "last_move": last.moved,
        "coefficients": {name: _coefficient(problem, last, k) for k, name in enumerate(problem.chosen.names)},
        **_groups(problem, last),
        **({} if problem.correction is None else {"correction": _correction(problem, last)}),
        "fitted": {
            "tracks": len(last.fits),
            "names": [fit.name for fit in last.fits],
            "skipped": dict(last.skipped),
        },
        "left_out": problem.split.left_out,
        "judged": {
            "tracks": len(comparison.pairs),
            "failed": comparison.failed,
            "better_on": comparison.better,
            "names": list(problem.split.judge),
            "before": _plain(comparison.before),
            "after": _plain(comparison.after),
            "after_with_spread": _plain(comparison.with_spread),
            "after_with_noise": _plain(comparison.with_noise),
            "outcome": outcome(comparison),
            "change": None if comparison.gain is None else asdict(comparison.gain),
            "worse": outcome(comparison) == "worse",
        },
        "noise": shown,
        "predicting_gain": last.predicting,
        "verdict": verdict(problem, last, comparison),
    }


def _coefficient(problem: Problem, last: Step, k: int) -> dict[str, Any]:
    chosen = problem.chosen
    mean, sigma, prior = last.mean[k], last.sigma[k], float(chosen.sigma[k])
    return {
        "unit": chosen.units[k],
        "before": float(chosen.start[k]),
        "after": mean,
        "sigma": sigma,
        "spread": last.spread[k],
        "next_track_sigma": last.next_track[k],
        "prior_sigma": prior,
        "told_by_data": sigma < (1.0 - NEW_INFORMATION) * prior,
        "at_bound": mean in (float(chosen.low[k]), float(chosen.high[k])),
    }


def _groups(problem: Problem, last: Step) -> dict[str, Any]:
    """The entry `groups`: spins by group, rad/s; none without groups."""
    if problem.groups is None:
        return {}
    spins = {name: spin.model_dump(mode="json") for name, spin in zip(problem.groups.names, last.spins, strict=True)}
    apart = {
        coefficient: dict(zip(problem.groups.names, values, strict=True))
        for coefficient, values in last.by_group.items()
    }
    return {"groups": {"by": problem.groups.by, "axes": list(AXES), "spin": spins, "coefficients": apart}}


def _correction(problem: Problem, last: Step) -> list[dict[str, float]]:
    """The correction of drag at some places; none without one."""
    if problem.correction is None:
        return []
    model = population_model(problem, last)
    speed, ratio = places(model)
    columns = {"speed": speed, "spin_ratio": ratio} | dict(
        zip(("drag", "sigma"), learned(model, "drag", speed, ratio), strict=True)
    )
    return [dict(zip(columns, map(float, row), strict=True)) for row in zip(*columns.values(), strict=True)]


def _plain(found: Summary | None) -> dict[str, Any] | None:
    return None if found is None else found.model_dump()


def verdict(problem: Problem, last: Step, comparison: Comparison) -> str:
    """Sentences: whether it predicts better, coefficients at a bound, errors, convergence, what data do not show."""
    before, after, gain = comparison.before, comparison.after, comparison.gain
    if before is None or after is None or gain is None:
        sentences = ["Too few tracks could be judged: whether the prediction is better is not known."]
    else:
        sentences = [f"The calibrated model predicts {gain.word}: {gain}."]
    if gain is not None and gain.word == "worse":
        sentences.append("Keep the model before, or give more tracks or other coefficients.")
    found = {name: _coefficient(problem, last, k) for k, name in problem.chosen.listed}
    for name in (name for name, one in found.items() if one["at_bound"]):
        sentences.append(f"{name} lies at its bound: another effect may be missing, or a unit is wrong.")
    if not has_converged(problem.config, last):
        sentences.append(
            f"The mean still moved by {last.moved:.2g} standard errors in iteration {last.number}: continue with a "
            "larger max_iterations."
        )
    if before is not None and after is not None:
        sentences.append(
            f"Median RMSE {1e3 * before.rmse_median:.1f} mm before, {1e3 * after.rmse_median:.1f} mm after; it fell on "
            f"{comparison.better} of {after.tracks} tracks."
        )
        if problem.dataset.rough:
            sentences.append("Errors are those across the rays of the cameras' sightings.")
    if last.predicting is not None:
        sentences.append(
            f"The means are those that predict best, by {last.predicting:+.3f} in the log score of fitted tracks that "
            "were left out, not the most probable ones: the model lacks something."
        )
    if comparison.with_spread is not None:
        sentences.append(
            f"With the population as each track's prior it has {1e3 * comparison.with_spread.rmse_median:.1f} mm."
        )
    if comparison.with_noise is not None:
        sentences.append(
            f"With the noise that the fitted tracks show, {1e3 * comparison.with_noise.rmse_median:.1f} mm, and 90 % "
            f"intervals hold {100 * comparison.with_noise.coverage_90:.0f} %."
        )
    for name, one in found.items():
        if not one["told_by_data"] and (problem.correction is None or name != SCALE):
            before_it, after_it = (f"{one[when]:.4g}" for when in ("before", "after"))
            moved = f"{after_it} is hardly surer than the model's {before_it}"
            known = "its value is the model's" if before_it == after_it else moved
            sentences.append(f"The tracks say little of {name}: {known}.")
    return " ".join(sentences)


def table(problem: Problem, last: Step, comparison: Comparison) -> str:
    """Coefficients and errors, before and after, as plain text."""
    rows: list[tuple[str, ...]] = [("", "unit", "before", "after", "sigma", "spread between tracks")]
    for k, name in problem.chosen.listed:
        values = (problem.chosen.start[k], last.mean[k], last.sigma[k], last.spread[k])
        rows.append((name, problem.chosen.units[k], *(f"{value:.4g}" for value in values)))
    names = () if problem.groups is None else problem.groups.names
    for coefficient, means in last.by_group.items():
        k = problem.chosen.names.index(coefficient)
        start, unit = f"{problem.chosen.start[k]:.4g}", problem.chosen.units[k]
        apart = zip(names, means, strict=True)
        rows += [(f"{coefficient} of {name}", unit, start, f"{value:.4g}", "", "") for name, value in apart]
    for name, spin in zip(names, last.spins, strict=True):
        for axis, *numbers in zip(AXES, spin.mean, spin.sigma, spin.spread, strict=True):
            rows.append((f"spin of {name}, {axis}", "rad/s", "0", *(f"{number:.4g}" for number in numbers)))
    for one in _correction(problem, last):
        place = f"drag's correction at {one['speed']:.2g} m/s, spin ratio {one['spin_ratio']:.2g}"
        rows.append((place, "1", "0", f"{one['drag']:.4g}", f"{one['sigma']:.4g}", "0"))
    errors: list[tuple[str, ...]] = [
        ("judged tracks", "unit", "before", "after", "after, spread as prior", "and noise")
    ]
    summaries = (comparison.before, comparison.after, comparison.with_spread, comparison.with_noise)
    for label, unit, name, scale in (
        ("RMSE, median", "mm", "rmse_median", 1e3),
        ("RMSE, pooled", "mm", "rmse_pooled", 1e3),
        ("90 % intervals hold", "%", "coverage_90", 1e2),
        ("NIS of predictions (3)", "1", "prediction_nis", 1.0),
        ("NIS of observed part (3)", "1", "nis", 1.0),
    ):
        cells = ("-" if s is None else f"{scale * getattr(s, name):.4g}" for s in summaries)
        errors.append((label, unit, *cells))
    return "\n\n".join("\n".join(aligned(part)) for part in (rows, errors))
