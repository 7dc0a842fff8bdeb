"""Plants effects of known strength in measured tracks, and judges whether a diagnosis names and measures them.

The set as it was and the changed set are both diagnosed. The strength in the set as it was is that of the finding; of
an effect that has no name there, the last round's score test gives it (one Gauss-Newton step from absence); of an
effect that no round tests (errors of stamps and the tracker), or that has no size, it is zero.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from ballfg.benchmarks.diagnosis.cases import Case, by_name
from ballfg.benchmarks.diagnosis.changes import CHANGES, applicable
from ballfg.benchmarks.diagnosis.record import Found, Record, is_one_of
from ballfg.benchmarks.diagnosis.suite import collect_records, run_case
from ballfg.benchmarks.metrics import Figure, share
from ballfg.benchmarks.pictures import BLUE, GREY, ORANGE, save
from ballfg.benchmarks.results import Results
from ballfg.diagnosis.residual_tests.tracker_errors import UNITS
from ballfg.dynamics import EFFECTS, Coefficient
from ballfg.estimation.noise.tracker_errors import JITTER, MEMORY
from ballfg.tracks import read_dataset

SETS = ("aimy", "ballgun", "robot_rallies", "spindoe")  # Folders that are changed if no other ones are given
PART, TITLE, ALL = "planted", "planted in measured sets", "all"
QUICK_TRACKS = 12  # Number of tracks of each set in a quick look
QUICK_CHANGES = ("frame_tilt", "stamp_jitter", "wind")  # One each of frame, noise and flight
RANDOM = (JITTER, MEMORY)  # Standard deviations: they add in squares to what the set had before
SIGMAS = 3.0  # Distance from the planted change up to which a strength counts as found
DRIFT = "_drift"  # Ending of the name of an effect that changes along the recording

Strength = tuple[float, float]  # Value and standard deviation


@dataclass(frozen=True)
class Outcome:
    """What became of one change in one set."""

    named: bool  # its effect is among the names
    changes: Mapping[str, Strength]
    """Of each coefficient, with its standard deviation, against the set as it was; empty if it is not named."""
    planted: Mapping[str, float]  # what the change of each coefficient should be
    names: tuple[str, ...] | None  # all names of the changed set; None if its diagnosis failed

    @property
    def ratio(self) -> Strength | None:
        """The change over the planted one, along the planted direction; None without a strength.

        Other coefficients of the effect do not count: drag or gravity, say, take up most of what they do.
        """
        if not self.changes:
            return None
        size = sum(p**2 for p in self.planted.values())
        parts = [(p * self.changes[c][0] / size, p * self.changes[c][1] / size) for c, p in self.planted.items()]
        return sum(value for value, _ in parts), math.hypot(*(sigma for _, sigma in parts))

    @property
    def found(self) -> bool:
        """True if the effect is named and its strength changed as planted, within three standard deviations."""
        ratio = self.ratio
        return ratio is not None and abs(ratio[0] - 1.0) <= SIGMAS * ratio[1]


def planted_cases(name: str, folder: Path, seed: int, chosen: Sequence[str], most: int | None) -> Iterator[Case]:
    """A set as it was, then with each of the chosen changes that it can have."""
    yield Case(PART, name, 1.0, seed, tuple(CHANGES), data=folder, most=most)
    for change in applicable(read_dataset(folder)):
        if change in chosen:
            yield Case(PART, f"{name}-{change}", 1.0, seed, (change,), data=folder, change=change, most=most)


def outcome_of(change: str, before: Record | None, after: Record | None) -> Outcome:
    """Whether a change got its name and its strength."""
    if before is None or after is None:
        return Outcome(False, {}, {}, None)
    names = tuple(found.name for found in after.found)
    named = any(is_one_of(found, (change,)) for found in after.found)
    own = [found for found in after.found if found.name == change]
    changes = _changes(change, _before(change, before), own[0], after.strengths) if own else {}
    return Outcome(named, changes, after.strengths, names)


def _changes(
    change: str, before: Mapping[str, Strength], found: Found, planted: Mapping[str, float]
) -> dict[str, Strength]:
    """The change of each coefficient, with its standard deviation; empty if one of them has none."""
    now = strengths(found.parameters)
    if not planted.keys() <= now.keys():
        return {}
    changes = {}
    for coefficient, should in planted.items():
        value, sigma = now[coefficient]
        listed = None if change.endswith(DRIFT) else _listed(change).get(coefficient)
        absent = 0.0 if listed is None or listed.absent is None else listed.absent
        was, its_sigma = before.get(coefficient, (absent, 0.0))
        expected, slope = was + should, 1.0
        if change in RANDOM:
            expected = math.hypot(was, should)
            slope = was / expected
        changes[coefficient] = should + value - expected, math.hypot(sigma, slope * its_sigma)
    return changes


def _before(change: str, record: Record) -> dict[str, Strength]:
    """The strength in the set as it was: of the finding, else of the last score test of an effect that has a size."""
    own = [found.parameters for found in record.found if found.name == change]
    usual = EFFECTS[change].usual if change in EFFECTS else None
    if not own and (usual is None or usual.graded):
        tested = [ranked.estimate for listed in record.rounds for ranked in listed if ranked.name == change]
        own = [estimate for estimate in tested if estimate][-1:]
    return strengths(own[0]) if own else {}


def strengths(values: Mapping[str, tuple[float, float | None]]) -> dict[str, Strength]:
    """Coefficients with a standard deviation; of one that changes along the recording, the change since the start.

    The two levels of such a change count as independent. They share the errors of all other coefficients, so that the
    stated standard deviation is rather too large.
    """
    found: dict[str, Strength] = {}
    for name, (value, sigma) in values.items():
        coefficient, first = name.partition("[")[0], found.get(name.partition("[")[0])
        if sigma is not None:
            found[coefficient] = (value, sigma) if first is None else (value - first[0], math.hypot(sigma, first[1]))
    return found


def _listed(change: str) -> dict[str, Coefficient]:
    """The coefficients of a change's effect by name; none for errors of the tracker."""
    effect = EFFECTS.get(change.removesuffix(DRIFT))
    return {} if effect is None else {c.name: c for c in effect.coefficients}


def run_planted(
    results: Results,
    folders: Sequence[Path],
    out: Path,
    chosen: Sequence[str],
    most: int | None,
    jobs: int,
    run: Callable[[Case], Record] = run_case,
) -> list[Path]:
    """Change, diagnose, compare, and add the rows. Finished diagnoses are kept in `out`, an existing folder.

    Args: chosen: names of changes.  most: number of tracks of each set; None for all.
    Returns: the picture written.
    """
    cases = {name: list(planted_cases(name, f, results.seed, chosen, most)) for name, f in by_name(folders).items()}
    records = collect_records([case for own in cases.values() for case in own], out, jobs, run)
    outcomes = {
        (name, case.change): outcome_of(case.change, records.get(own[0].name), records.get(case.name))
        for name, own in cases.items()
        for case in own[1:]
    }
    add_rows(results, outcomes)
    return [planted_picture(outcomes, out / "planted.png")]


def add_rows(results: Results, outcomes: Mapping[tuple[str, str], Outcome]) -> None:
    """Shares over all sets and changes, by set and by change; of each cell its answer and its coefficients."""
    lines = dict.fromkeys([ALL, *(name for name, _ in outcomes), *(change for _, change in outcomes)])
    for line in lines:
        own = [outcome for key, outcome in outcomes.items() if line in (ALL, *key)]
        results.add(TITLE, "named", line, "1", share([outcome.named for outcome in own]), len(own))
        results.add(TITLE, "within 3 sigma", line, "1", share([outcome.found for outcome in own]), len(own))
    for (name, change), outcome in outcomes.items():
        results.add(name, "named", change, "1", float(outcome.named), 1)
        results.add(name, "within 3 sigma", change, "1", float(outcome.found), 1)
        for coefficient, should in ((c, p) for c, p in outcome.planted.items() if p):
            row, unit = f"{change}.{coefficient}", UNITS.get(change) or _listed(change)[coefficient].unit
            results.add(name, "planted", row, unit, should, 1)
            if coefficient in outcome.changes:
                value, sigma = outcome.changes[coefficient]
                ends = value - SIGMAS * sigma, value + SIGMAS * sigma
                results.add(name, "change", row, unit, Figure(value, *ends), 1)


def planted_picture(outcomes: Mapping[tuple[str, str], Outcome], path: Path) -> Path:
    """The change of each strength over the planted one, a panel for each set; names where the right one is missing."""
    sets, changes = (list(dict.fromkeys(key[place] for key in outcomes)) for place in (0, 1))
    size = (3.6 * len(sets) + 1.6, 0.42 * len(changes) + 1.7)
    figure, panels = plt.subplots(1, len(sets), figsize=size, sharey=True, squeeze=False, layout="constrained")
    for axes, name in zip(panels[0], sets, strict=True):
        for row, change in enumerate(changes):
            if (name, change) in outcomes:
                _draw(axes, row, outcomes[name, change])
        axes.axvline(1.0, color="black", linewidth=0.8)
        axes.set(title=name, xlim=(-0.1, 2.1), ylim=(len(changes) - 0.5, -0.5))
        axes.grid(visible=True, axis="x", alpha=0.25)
    panels[0, 0].set_yticks(range(len(changes)), changes)
    figure.supxlabel("found change / planted change; bars: 3 sigma; blue: within, orange: outside", size=9)
    figure.suptitle("Planted in measured tracks; grey: what was named in its place", size=11)
    return save(figure, path)


def _draw(axes: Axes, row: int, outcome: Outcome) -> None:
    ratio = outcome.ratio
    if ratio is not None:
        colour, value = BLUE if outcome.found else ORANGE, float(np.clip(ratio[0], 0.0, 2.0))
        axes.errorbar(value, row, xerr=SIGMAS * ratio[1], fmt="o", color=colour, markersize=5, capsize=2)
        return
    words = "failed" if outcome.names is None else "\n".join(outcome.names) or "no name"
    axes.text(-0.05, row, words, va="center", size=5.5, color=BLUE if outcome.named else GREY)
