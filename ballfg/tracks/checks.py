"""Checks the rules of a whole trajectory, makes two repairs with a note, and reports doubts about its frame.

Repairs: rows out of time order are sorted, exact repeats are dropped. Two different rows at one stamp that lie close
together count as one measurement with an inaccurate stamp: their mean replaces them.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from ballfg.arrays import Array, median
from ballfg.checks import shown
from ballfg.progress import counted

if TYPE_CHECKING:
    from ballfg.tracks.rows import RowGroup

MERGE_DISTANCE = 0.1  # m: two rows at one stamp farther apart are refused; one frame of a ball at 15 m/s and 150 Hz
MAX_COORDINATE = 1000.0  # m: positions farther from the origin are refused
MAX_EXTENT = 250.0  # m: a longer track is refused; no struck ball flies farther
MAX_SPEED = 343.0  # m/s: a track whose median speed is above that of sound is refused
MIN_SIGMA, MAX_SIGMA = 1e-9, 1e6  # m, of a sample; a large one marks a sample with little weight
MAX_MEDIAN_SIGMA = 1.0  # m: a track with a larger median sigma is refused
MAX_STEP = 1.0  # s: a track whose median time step is longer is refused; no bounce could be seen in it
MIN_STEP = 1e-6  # s: a track whose median time step is shorter is refused; no camera is that fast
MAX_RATE_RATIO = 100.0  # a median time step that differs from the declared rate by more than this factor is refused

_NAMED = 3  # number of trajectories that a note names

Where = Callable[..., str]


@dataclass
class Findings:
    """The repairs made during the check of a dataset."""

    repeats: int = 0
    sorted_tracks: list[str] = field(default_factory=list)
    merged: list[str] = field(default_factory=list)
    merged_distance: float = 0.0

    def notes(self) -> list[str]:
        """One sentence for each kind of repair."""
        notes = []
        if self.repeats:
            notes.append(f"{counted(self.repeats, 'exact repeat')} dropped")
        if late := len(self.sorted_tracks):
            count = f"{late} trajector{'y' if late == 1 else 'ies'}"
            notes.append(f"rows of {count} were not in time order: sorted ({_some(self.sorted_tracks)})")
        if merged := len(self.merged):
            what = f"{counted(merged, 'stamp')} with different rows"
            most = f"up to {self.merged_distance * 100:.1f} cm apart"
            notes.append(f"{what}, {most}: averaged ({_some(self.merged)})")
        return notes


def check_step(label: str, stamps: Array) -> None:
    """Refuses stamps (n,) s, increasing, with a median step out of `MIN_STEP` to `MAX_STEP`. Raises: ValueError."""
    step = float(np.median(np.diff(stamps))) if len(stamps) > 2 else MIN_STEP
    if not MIN_STEP <= step <= MAX_STEP:
        problem = f"{label}: t must be in s, with a median step of {MIN_STEP:g} to {MAX_STEP:g} s; got {step:.4g} s"
        raise ValueError(f"{problem}. The unit is probably ms or us: convert it.")


def check_overlap(spans: Mapping[str, tuple[float, float]], within: float = 0.0) -> None:
    """Refuses a camera that recorded while no other did, nor within a time of it, s. Raises: ValueError: all times.

    Args: spans: s, true time, the first and the last moment of each camera by its name.
    """
    or_soon = f", or follow one another within {within:g} s" if within else ""
    for name, (start, end) in spans.items():
        others = [span for other, span in spans.items() if other != name]
        if others and not any(start <= last + within and first <= end + within for first, last in others):
            rounded = {other: np.round(span, 3).tolist() for other, span in spans.items()}
            when = "; ".join(
                f"{shown(other)} {first:.13g} to {last:.13g} s" for other, (first, last) in rounded.items()
            )
            problem = f"videos must overlap in time{or_soon}; camera {shown(name)} overlaps with no other: {when}"
            raise ValueError(
                f"{problem} (true time). Check stamps and time_offset, or that the files are of one recording."
            )


def tidy(group: "RowGroup", where: Where, findings: Findings | None = None) -> Array:
    """The samples of one trajectory, one for each stamp, in time order.

    Returns: (n, 4) or (n, 7), columns as in Block; repairs are added to the findings.
    Raises: ValueError: fewer than two stamps, or two rows at one stamp more than MERGE_DISTANCE apart.
    """
    findings = Findings() if findings is None else findings
    values, rows = group.values, group.rows
    if (np.diff(values[:, 0]) < 0).any():
        findings.sorted_tracks.append(repr(group.name))
        order = np.argsort(values[:, 0], kind="stable")
        values, rows = values[order], rows[order]
    if (np.diff(values[:, 0]) == 0).any():
        values = _one_per_stamp(replace(group, rows=rows, values=values), where, findings)
    if len(values) < 2:
        raise ValueError(
            f"{where(int(rows[0]))}: trajectory {shown(group.name)} must have at least two samples at different times; "
            "got one. Delete it."
        )
    return values


def fuse(values: Array) -> Array:
    """The mean of different measurements of one position at one stamp.

    With sigmas it is weighted by 1 / sigma^2, and its sigma is that of the weighted mean, times a factor >= 1 if the
    measurements disagree by more than their sigmas allow.

    Args: values: (k, 4) or (k, 7), k >= 2, one stamp.
    Returns: (4,) or (7,).
    Source: Particle Data Group, Review of Particle Physics, Introduction, unconstrained averaging (scale factor S).
    """
    if values.shape[1] == 4:
        return np.concatenate([values[0, :1], values[:, 1:].mean(axis=0)])
    positions, weights = values[:, 1:4], values[:, 4:] ** -2.0
    total = weights.sum(axis=0)
    mean = (weights * positions).sum(axis=0) / total
    chi2 = (weights * (positions - mean) ** 2).sum(axis=0)
    scale = np.sqrt(np.maximum(1.0, chi2 / (len(values) - 1)))
    return np.concatenate([values[0, :1], mean, scale / np.sqrt(total)])


def check_scale(label: str, times: Array, positions: Array, sigmas: Array | None, rate: float | None) -> None:
    """Refuses times (n,) s and positions (n, 3) m that cannot be in these units. Raises: ValueError: the likely one."""
    steps = np.diff(times)
    step = float(median(steps))
    misses_rate = rate is not None and not 1 / MAX_RATE_RATIO <= step * rate <= MAX_RATE_RATIO
    low, high = positions.min(axis=0), positions.max(axis=0)
    farthest = float(max(high.max(), -low.min()))
    extent = float(np.hypot.reduce(high - low))
    if extent > MAX_EXTENT:
        problem = f"{label}: x, y, z must be in m, and a track at most {MAX_EXTENT:g} m long; got {extent:.4g}"
        raise ValueError(f"{problem}. The unit is probably mm: divide by 1000.")
    if farthest > MAX_COORDINATE:
        raise ValueError(
            f"{label}: x, y, z must be in m and within {MAX_COORDINATE:g} m of the origin; got {farthest:.4g}. "
            "The unit is probably mm (divide by 1000), or the origin is far away (move it to the table)."
        )
    if step > MAX_STEP or step < MIN_STEP or misses_rate:
        expected = f"{MIN_STEP:g} to {MAX_STEP:g} s apart" + (f", near 1/{rate:g} s (rate)" if rate else "")
        problem = f"{label}: t must be in s, its stamps {expected}; got a median step of {step:.4g}"
        raise ValueError(f"{problem}. {_time_remedy(step, rate)}")
    with np.errstate(over="ignore"):  # a single step may be almost zero
        speed = float(median(np.linalg.norm(np.diff(positions, axis=0), axis=1) / steps))
    if speed > MAX_SPEED:
        raise ValueError(
            f"{label}: x, y, z must be in m and t in s; got a median speed of {speed:.4g} m/s, above that of sound. "
            "The unit of x, y, z is probably mm or cm: convert it to m."
        )
    if sigmas is not None and np.median(sigmas) > MAX_MEDIAN_SIGMA:
        rule = f"{label}: sigmas must be in m, their median at most {MAX_MEDIAN_SIGMA:g}"
        raise ValueError(f"{rule}; got {np.median(sigmas):.4g}. The unit is probably mm: divide by 1000.")


def _one_per_stamp(group: "RowGroup", where: Where, findings: Findings) -> Array:
    values = group.values
    starts = np.flatnonzero(np.concatenate([[True], np.diff(values[:, 0]) != 0]))
    kept = values[starts].copy()
    ends = np.append(starts[1:], len(values))
    for i in np.flatnonzero(ends - starts > 1):
        same = values[starts[i] : ends[i]]
        distinct = np.unique(same, axis=0)
        findings.repeats += len(same) - len(distinct)
        if len(distinct) == 1:
            continue
        distances = np.linalg.norm(same[:, 1:4] - same[0, 1:4], axis=1)
        farthest = int(np.argmax(distances))
        if distances[farthest] > MERGE_DISTANCE:
            first, second = int(group.rows[starts[i]]), int(group.rows[starts[i] + farthest])
            raise ValueError(
                f"{where(first, second)}: trajectory {shown(group.name)} must have one position for each time; got "
                f"two, {distances[farthest]:.3g} m apart, at t={same[0, 0]}. Delete one, or give two balls two names."
            )
        kept[i] = fuse(distinct)
        findings.merged.append(f"{shown(group.name)} at t={same[0, 0]}")
        findings.merged_distance = max(findings.merged_distance, float(distances[farthest]))
    return kept


def _time_remedy(step: float, rate: float | None) -> str:
    true_step = 1 / rate if rate else 0.01
    if step < true_step:
        return "Convert it to s" + (", or correct rate in dataset.yaml." if rate else ".")
    units = {"ms": 1e3, "us": 1e6, "ns": 1e9}
    unit = min(units, key=lambda name: abs(np.log(step / (true_step * units[name]))))
    return f"The unit is probably {unit}: divide by {units[unit]:g}."


def _some(names: list[str]) -> str:
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")
