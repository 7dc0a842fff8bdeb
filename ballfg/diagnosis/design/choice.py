"""Chooses the shots that together determine the wanted coefficients best, among all combinations of given levels.

They minimise the log of the error bar, averaged over all sides and their directions (docs/design_shots.md): greedily,
then by exchanges one by one while that helps, then sorted by their gain.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ballfg.arrays import Array
from ballfg.diagnosis.design.information import Information

Measure = Callable[[Array], Array]  # (m,) measures of information matrices (m, q, q)
LEAST_GAIN = 1e-9  # Least decrease of the measure by an exchange, against cycles
DRAWS = 100  # Number of random choices whose median error bars are the comparison


@dataclass(frozen=True)
class Choice:
    """Chosen shots in order, with error bars after each.

    Attributes:
        shots: (k,) numbers of candidates among `Information.shots`.
        error, random: (k + 1,) mean error bar of all sides, in prior standard deviations of the unknowns, first without
            shots; the same after as many random shots, the median of `DRAWS` choices.
        sigmas: (k + 1, p) standard deviation of each coefficient asked about, in its own unit.
        as_random: number of random shots with the same gain as all chosen ones.
    """

    shots: list[int]
    error: Array
    random: Array
    sigmas: Array
    as_random: float


def choose(
    information: Information, sides: Sequence[Sequence[str]], names: Sequence[str], count: int, seed: int
) -> Choice:
    """Choose so many shots, with repetition.

    Args: sides: coefficients that should be known well, by parameter name.  names: of those whose error bars are
        reported.  seed: of the random choices for comparison.
    """
    columns = [information.columns(side) for side in sides]
    known, shots = information.known, information.shots

    def measure(totals: Array) -> Array:
        covariance = np.linalg.inv(totals)
        logs = [np.linalg.slogdet(covariance[:, side][:, :, side])[1] / (2 * len(side)) for side in columns]
        return np.asarray(np.mean(logs, axis=0))

    greedy = _greedy(known, shots, list(range(len(shots))), count, measure, repeated=True)
    exchanged = _exchanged(known, shots, greedy, measure)
    chosen = _greedy(known, shots, sorted(exchanged), count, measure, repeated=False)
    totals = known + np.concatenate((np.zeros((1, *known.shape)), np.cumsum(shots[chosen], axis=0)))
    wanted = information.columns(names)
    covariances = np.linalg.inv(totals)[:, wanted, wanted]
    rng = np.random.default_rng(seed)
    drawn = [np.cumsum(shots[rng.integers(len(shots), size=count)], axis=0) for _ in range(DRAWS)]
    random = np.median([measure(known + draw) for draw in drawn], axis=0)
    reached = float(measure(totals[-1:])[0])
    return Choice(
        chosen,
        np.exp(measure(totals)),
        np.exp(np.concatenate((measure(known[None]), random))),
        np.sqrt(covariances) * information.units[wanted],
        _as_random(known, shots.mean(axis=0), measure, reached),
    )


def _greedy(
    known: Array, shots: Array, listed: list[int], count: int, measure: Measure, *, repeated: bool
) -> list[int]:
    """Listed shots, each the best one beside those before it."""
    order: list[int] = []
    for _ in range(count):
        best = int(np.argmin(measure(known + shots[listed])))
        order.append(listed[best] if repeated else listed.pop(best))
        known = known + shots[order[-1]]
    return order


def _exchanged(known: Array, shots: Array, chosen: list[int], measure: Measure) -> list[int]:
    """Replaces each shot in turn by the best one beside the others, until no exchange helps."""
    chosen, total = list(chosen), known + shots[chosen].sum(axis=0)
    now, helped = float(measure(total[None])[0]), True
    while helped:
        helped = False
        for place, old in enumerate(chosen):
            others = total - shots[old]
            values = measure(others + shots)
            best = int(np.argmin(values))
            if values[best] < now - LEAST_GAIN:
                chosen[place], total, now, helped = best, others + shots[best], float(values[best]), True
    return chosen


def _as_random(known: Array, mean: Array, measure: Measure, reached: float) -> float:
    """Number of mean shots that reach a measure: by bisection, since more information never raises it."""
    low, high = 0.0, 1.0

    def too_few(count: float) -> bool:
        return float(measure((known + count * mean)[None])[0]) > reached

    while too_few(high) and high < 1e6:
        low, high = high, 2.0 * high
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if too_few(middle) else (low, middle)
    return high


MOST = 5000  # Largest number of combinations. More take minutes, and neighbours hardly differ


def parse_levels(text: str, what: str = "candidates") -> dict[str, list[float]]:
    """Rising levels by setting, of a text such as `topspin=-3..5,wheel=1200..2000:200,speed=9`.

    Args: what: name of the text in messages.

    Raises: ValueError: a text of another form, a repeated setting, a step that is not positive, or too many
        combinations.
    """
    found: dict[str, list[float]] = {}
    for part in text.split(","):
        name, _, span = part.partition("=")
        name = name.strip()
        if name in found:
            raise ValueError(f"{what} must name each setting once; got '{name}' twice. Remove one.")
        found[name] = _levels(name, span, part.strip(), what)
    count = math.prod(len(levels) for levels in found.values())
    if count > MOST:
        raise ValueError(
            f"{what} must be at most {MOST} combinations; got {count}. Use larger steps: NAME=FROM..TO:STEP."
        )
    return found


def _levels(name: str, span: str, part: str, what: str) -> list[float]:
    ends, _, width = span.partition(":")
    low, dots, high = ends.partition("..")
    try:
        first, last, step = float(low), float(high if dots else low), float(width) if width else 1.0
    except ValueError:
        first = last = step = math.nan
    if not name or not (math.isfinite(first) and math.isfinite(last) and first <= last and 0.0 < step < math.inf):
        raise ValueError(
            f"{what} must read NAME=LEVEL, NAME=FROM..TO or NAME=FROM..TO:STEP, separated by commas; got '{part}'. "
            "Write for instance topspin=-3..5,sidespin=-5..5,speed=8..14 or x=-4..4:2."
        )
    if (last - first) / step >= MOST:
        raise ValueError(f"{what} must be at most {MOST} combinations; {name} alone has more. Use a larger step.")
    return [first + step * k for k in range(math.floor((last - first) / step + 1e-9) + 1)]


def combinations(levels: Mapping[str, Sequence[float]]) -> Array:
    """(m, s) every combination of the levels of s settings, the last setting changing fastest."""
    return np.array(list(itertools.product(*levels.values())), dtype=np.float64)
