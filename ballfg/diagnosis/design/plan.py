"""Plans the next, most informative shots of a launcher.

A map from a launcher's settings to first states is learned from its shots: place, speed, azimuth, elevation and spin
are linear in the settings. The spin is that about forward, across and up, so that it turns along with the launcher.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import did_you_mean
from ballfg.diagnosis.design.choice import choose, combinations
from ballfg.diagnosis.design.goal import separating, shrinking
from ballfg.diagnosis.design.information import information_of
from ballfg.diagnosis.fit.holdout import Holdout, hold_out
from ballfg.diagnosis.fit.problem import Fit, launch_axes
from ballfg.diagnosis.search.evaluation import on_all
from ballfg.diagnosis.search.stamp_effects import first_fit
from ballfg.dynamics import AnalyticModel
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY
from ballfg.tracks import Dataset, Track

SPARE = 2  # Number of shots beyond one for each parameter of the line; fewer do not show the scatter about it
LEAST_SHARE = 1e-8
"""Smallest over largest eigenvalue of the settings' correlations: below, settings changed together only."""


@dataclass(frozen=True)
class LauncherMap:
    """First states as a linear function of the settings."""

    names: tuple[str, ...]  # Of s settings, as in labels
    weights: Array
    """(s + 1, 9) of a constant and the settings, for place (m), speed (m/s), azimuth and elevation (rad), and the spin
    about forward, across and up (rad/s)."""
    scatter: Array  # (9,) standard deviations of the shots about the line, in the same units
    low: Array  # (s,) least measured settings
    high: Array  # (s,) largest ones

    def states(self, settings: Array) -> Array:
        """(m, 9) first states of shots with settings (m, s)."""
        launches = np.column_stack((np.ones(len(settings)), settings)) @ self.weights
        speed, azimuth, elevation = launches[:, 3:6].T
        states = launches.copy()
        level = speed * np.cos(elevation)
        states[:, 3:6] = np.stack((level * np.cos(azimuth), level * np.sin(azimuth), speed * np.sin(elevation)), axis=1)
        states[:, SPIN] = (launch_axes(states) @ launches[:, 6:, None])[..., 0]
        return np.asarray(states)

    def outside(self, settings: Array) -> list[str]:
        """A sentence for each setting whose candidates (m, s) exceed the measured ones."""
        least, most = settings.min(axis=0), settings.max(axis=0)
        return [
            f"{name} was shot from {self.low[i]:g} to {self.high[i]:g}; candidates from {least[i]:g} to {most[i]:g} "
            "continue the launcher's line beyond that"
            for i, name in enumerate(self.names)
            if least[i] < self.low[i] or most[i] > self.high[i]
        ]


def learn_launcher(names: Sequence[str], settings: Array, states: Array) -> LauncherMap:
    """Fits the line through the first states (n, 9) of shots with settings (n, s) of these names.

    Raises: ValueError: too few shots, or settings that did not change independently of each other.
    """
    count, needed = len(settings), settings.shape[1] + 1 + SPARE
    if count < needed:
        raise ValueError(
            f"the dataset must hold at least {needed} shots with the labels {', '.join(names)}, to learn what they do; "
            f"got {count}. Shoot more."
        )
    still = [name for name, column in zip(names, settings.T, strict=True) if np.ptp(column) == 0.0]
    if still:
        raise ValueError(
            f"label {still[0]} must change from shot to shot, or nobody knows what it does; all shots have "
            f"{settings[0, list(names).index(still[0])]:g}. Leave it out of the candidates."
        )
    scaled = (settings - settings.mean(axis=0)) / settings.std(axis=0)
    values = np.linalg.eigvalsh(scaled.T @ scaled)
    if values[0] < LEAST_SHARE * values[-1]:
        raise ValueError(
            f"labels {', '.join(names)} must change independently of each other; in these shots some change together "
            "only. Name fewer of them."
        )
    velocity, launches = states[:, VELOCITY], np.zeros((count, STATE_DIM))
    mean = np.arctan2(velocity[:, 1].sum(), velocity[:, 0].sum())  # near which azimuths stay
    turned = np.arctan2(velocity[:, 1], velocity[:, 0]) - mean
    azimuth = mean + np.arctan2(np.sin(turned), np.cos(turned))
    elevation = np.arctan2(velocity[:, 2], np.hypot(velocity[:, 0], velocity[:, 1]))
    launches[:, POSITION] = states[:, POSITION]
    launches[:, 3:6] = np.stack((np.linalg.norm(velocity, axis=1), azimuth, elevation), axis=1)
    launches[:, 6:] = (launch_axes(states).swapaxes(-1, -2) @ states[:, SPIN, None])[..., 0]
    design = np.column_stack((np.ones(count), settings))
    weights, *_ = np.linalg.lstsq(design, launches, rcond=None)
    scatter = np.sqrt(((launches - design @ weights) ** 2).sum(axis=0) / (count - design.shape[1]))
    return LauncherMap(
        tuple(names), np.asarray(weights, dtype=np.float64), scatter, settings.min(axis=0), settings.max(axis=0)
    )


MOST_SHOTS = 1000
"""Largest number of shots; more are better planned in parts, each with the tracks of the earlier parts."""


@dataclass(frozen=True)
class ShotPlan:
    """The next shots, in order, and their gain.

    Attributes:
        settings: (k, s) of the launcher, in the units of the labels.
        setting_names: of the s settings.
        sides: coefficients to separate or shrink, by effect and coefficient, for instance (("wind.x",), ("drag.k",)).
        names: of the p coefficients of all sides, by effect and coefficient.
        units: of the coefficients.
        sigmas: (k + 1, p) in `units`, standard deviation of each, all else unknown, before the shots and after each.
        error: (k + 1,) dimensionless, mean error bar of the sides over the priors of the fit.
        random: (k + 1,) dimensionless, the same after as many random shots.
        as_random: number of random shots with the same gain as all k.
        candidates: number of usable candidates.
        remarks: sentences on unusable candidates and on the accuracy of the launcher's map.
    """

    settings: Array
    setting_names: tuple[str, ...]
    sides: tuple[tuple[str, ...], ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    sigmas: Array
    error: Array
    random: Array
    as_random: float
    candidates: int
    remarks: tuple[str, ...]


def design_shots(
    dataset: Dataset,
    model: AnalyticModel,
    levels: Mapping[str, Sequence[float]],
    *,
    between: Sequence[tuple[str, str]] = (),
    shrink: str = "",
    shots: int = 10,
    seed: int = 0,
    jobs: int = 1,
    watch: Callable[[str], None] | None = None,
) -> ShotPlan:
    """Chooses the shots that best separate effects, or that shrink the error bar of a coefficient most.

    Args:
        dataset: tracks of the launcher, with its settings as labels.
        model: as declared; it is fitted to the tracks first.
        levels: candidates, the levels of each setting by the name of its label; all combinations count.
        between: pairs of effects or coefficients to separate, `("wind.x", "drag.k")`.
        shrink: a coefficient, `drag.k`; either this or `between`.
        shots: number of shots; a setting may be repeated.
        seed: of the random shots for comparison.
        jobs: processes.
        watch: called with lines of progress.
    Returns: the shots with the expected standard deviations.
    Raises: ValueError: neither or both of `between` and `shrink`, missing or textual labels, too few or too uniform
        tracks for the launcher's map, unknown effects, or no candidate that flies.
    """
    if bool(between) == bool(shrink):
        raise ValueError("either between or shrink must say what the shots are for. Give one of them.")
    if not 1 <= shots <= MOST_SHOTS:
        raise ValueError(f"shots must be 1 to {MOST_SHOTS}; got {shots}. Choose another number.")
    names = tuple(levels)
    check_labels(dataset, names)
    holdout = hold_out(dataset, model, jobs, watch)
    fit = on_all(first_fit(model, holdout), holdout.held_out)
    goal = separating(fit, between) if between else shrinking(fit, shrink)
    candidates, launcher = combinations(levels), _launcher(fit, holdout.tracks, names)
    starts, settings = launcher.states(candidates), _known_settings(holdout, fit, names, candidates)
    if watch is not None:
        watch(f"flying {len(candidates)} candidates")
    information = information_of(fit, goal, starts, settings, holdout.surfaces)
    choice = choose(information, goal.sides, goal.names, shots, seed)
    units = {name: c.unit for name, c in fit.problem.free.items()}
    for h in goal.hypotheses:
        units |= {h.parameter(n): h.coefficients[n].unit for n in h.strengths}
    return ShotPlan(
        candidates[information.kept[choice.shots]],
        names,
        tuple(tuple(map(_short, side)) for side in goal.sides),
        tuple(map(_short, goal.names)),
        tuple(units[name] for name in goal.names),
        choice.sigmas,
        choice.error,
        choice.random,
        choice.as_random,
        len(information.kept),
        (*_remarks(launcher, candidates, len(information.kept)), *holdout.excluded),
    )


def check_labels(dataset: Dataset, names: Sequence[str]) -> None:
    """Refuses settings without a column of labels. Raises: ValueError."""
    for name in names:
        if name not in dataset.label_names:
            present = ", ".join(dataset.label_names) or "none"
            raise ValueError(
                f"candidates must be columns of the dataset's labels.csv; '{name}' is none of them, there are: "
                f"{present}.{did_you_mean(name, dataset.label_names)} Name those that the launcher was set to."
            )


def _launcher(fit: Fit, tracks: Sequence[Track], names: tuple[str, ...]) -> LauncherMap:
    """The launcher's map, from the first states of tracks with all its settings as labels.

    A first stretch that starts later on, as behind a hit, does not show what the launcher did.
    """
    named, stretches = {track.name: track for track in tracks}, fit.problem.stretches
    firsts = np.unique(stretches.track, return_index=True)[1]
    begun = stretches.positions[:, 0].numpy()
    launched = [i for i in firsts if (begun[i] == named[stretches.names[i]].positions[0]).all()]
    labels = {i: named[stretches.names[i]].labels for i in launched}
    told = [i for i in launched if all(isinstance(labels[i].get(name), float | int) for name in names)]
    rows = [[float(labels[i][name]) for name in names] for i in told]
    return learn_launcher(names, np.array(rows).reshape(-1, len(names)), fit.unknowns.starts[told])


def _known_settings(holdout: Holdout, fit: Fit, names: tuple[str, ...], candidates: Array) -> Array:
    """(m, s) settings of the fit's launcher; settings other than candidates stay at their mean."""
    launcher, used = holdout.launcher.embedding.names, fit.problem.stretches.settings
    usual = used[used.any(axis=1)].mean(axis=0, keepdims=True) if used.any() else used[:1]
    settings = np.repeat(usual, len(candidates), 0)
    for place, name in enumerate(names):
        if name in launcher:
            settings[:, launcher.index(name)] = candidates[:, place]
    return settings


def _remarks(launcher: LauncherMap, candidates: Array, usable: int) -> list[str]:
    scatter, count = launcher.scatter, len(candidates)
    lost = f"{count - usable} of {count} candidates leave the cameras' view at once or roll"
    spread = (
        f"first states follow the settings to {1e3 * np.sqrt((scatter[:3] ** 2).mean()):.0f} mm, {scatter[3]:.2g} m/s, "
        f"{np.degrees(max(scatter[4:6])):.1f} degrees and {np.sqrt((scatter[6:] ** 2).mean()):.0f} rad/s"
    )
    return [spread, *launcher.outside(candidates), *([lost] if usable < count else [])]


def _short(parameter: str) -> str:
    """Effect and coefficient, without the kind: `wind.x` of `flight.wind.x`."""
    return parameter.partition(".")[2]
