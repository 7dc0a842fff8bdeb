"""How well flights are found in recordings, against their truth.

    python -m tests.estimation.flights.found --count 200 --seed 1000
    python -m tests.estimation.flights.found --count 100 --seed 1000 --low-pass 6

prints the share of samples labelled right, of flights found whole (release and end within 2 samples; and, where the
noise hides a sample, where the motions differ by less than 2 sigma), false flights, true flight without an estimate,
and the share of recordings that are said to be smoothed or no free fall. Seeds 0 to 83 chose the constants.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ballfg.estimation.flights.dataset import ENOUGH, SMOOTHED, UNDISTURBED, error_ratios, pieces_of
from ballfg.estimation.flights.labels import label_samples
from ballfg.estimation.result import Label
from ballfg.importing.proposal import ANY_BALL
from tests.estimation.flights.recordings import FLIGHT, KINDS, Recording, recording

LEAST_ROWS = 4
"""Least number of samples for a parabola that is carried on."""
NEAR = 2
"""Samples by which the ends of a flight may differ."""


@dataclass
class Count:
    """Sums over recordings."""

    samples: int = 0
    right: int = 0
    flights: int = 0
    whole: int = 0
    as_whole: int = 0
    found: int = 0
    false: int = 0
    seconds: float = 0.0
    lost: float = 0.0
    smoothed: int = 0
    said: int = 0
    recordings: int = 0
    missed: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return (
            f"{100 * self.right / self.samples:.1f} % of {self.samples} samples right; {self.whole} of {self.flights} "
            f"flights whole ({100 * self.whole / max(self.flights, 1):.1f} %), {self.as_whole} as far as the noise "
            f"shows ({100 * self.as_whole / max(self.flights, 1):.1f} %); {self.false} of {self.found} found ones "
            f"false; {100 * self.lost / max(self.seconds, 1e-9):.2f} % of {self.seconds:.0f} s lost; of "
            f"{self.recordings} {self.smoothed} said to be smoothed, {self.said} that or mostly no free fall"
        )


def runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last sample, inclusive, of each run of True."""
    edges = np.flatnonzero(np.diff(mask, prepend=False, append=False)).reshape(-1, 2)
    return [(int(a), int(b) - 1) for a, b in edges]


def hidden(one: Recording, end: int, found: int) -> bool:
    """True if the motion between a true and a found end of a flight differs from flight by less than 2 sigma.

    A parabola through the five true samples inside of the end is carried to the found one.
    """
    inside = range(end, end + 5) if one.labels[min(end + 4, len(one.labels) - 1)] == FLIGHT else range(end - 4, end + 1)
    rows = [i for i in inside if 0 <= i < len(one.truth)]
    if len(rows) < LEAST_ROWS:
        return False
    t, away = one.track.times * one.rate, one.track.times[found] * one.rate
    fits = [np.polyfit(t[rows] - away, one.truth[rows, k], 2)[-1] for k in range(3)]
    return bool(np.linalg.norm(np.array(fits) - one.truth[found]) < 2.0 * one.noise)


def take(one: Recording, count: Count) -> None:
    """Adds a recording."""
    labels = label_samples(one.track, ANY_BALL)
    names = np.array([label.name.lower() for label in Label])[labels.values]
    truth, flying = np.array(one.labels), np.array(one.labels) == FLIGHT
    count.samples, count.right = count.samples + len(names), count.right + int((names == truth).sum())
    found = labels.stretches(Label.FLIGHT)
    for first, last in runs(flying):
        near = [(a, b) for a, b in found if b >= first and a <= last]
        whole = any(abs(a - first) <= NEAR and abs(b - last) <= NEAR for a, b in near)
        ends = any(all(abs(x - y) <= NEAR or hidden(one, x, y) for x, y in ((first, a), (last, b))) for a, b in near)
        count.flights, count.whole, count.as_whole = count.flights + 1, count.whole + whole, count.as_whole + ends
        count.missed += (
            [] if whole else [f"{one.track.name} {one.rate:g} Hz {1e3 * one.noise:.1f} mm {first}-{last} {near}"]
        )
    count.found += len(found)
    count.false += sum(flying[a : b + 1].mean() < 0.5 for a, b in found)
    used = np.zeros(len(names), dtype=bool)
    for piece in pieces_of(labels):
        used[piece.first : piece.last + 1] = True
    count.seconds, count.lost = count.seconds + flying.sum() / one.rate, count.lost + (flying & ~used).sum() / one.rate
    ratios = error_ratios(one.track, labels)
    smoothed = len(ratios) > 0 and float(np.quantile(ratios, UNDISTURBED)) > SMOOTHED
    count.smoothed += smoothed
    count.said += smoothed or (labels.values == Label.FLIGHT).mean() < ENOUGH
    count.recordings += 1


def main() -> None:
    """Prints the counts, of all recordings and by kind."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--low-pass", type=float, help="Hz")
    parser.add_argument("--kind", choices=KINDS)
    parser.add_argument("--missed", action="store_true")
    chosen = parser.parse_args()
    total, kinds, spent = Count(), {kind: Count() for kind in KINDS}, 0.0
    for seed in range(chosen.seed, chosen.seed + chosen.count):
        one = recording(seed, chosen.low_pass, chosen.kind)
        start = time.perf_counter()
        for count in (total, kinds[one.kind]):
            take(one, count)
        spent += time.perf_counter() - start
    print(total)
    print(f"{0.5e3 * spent / total.samples:.2f} ms a sample")
    for kind, count in kinds.items():
        if count.samples:
            print(f"  {kind}: {count}")
    if chosen.missed:
        print(*total.missed, sep="\n")


if __name__ == "__main__":
    main()
