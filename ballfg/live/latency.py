"""Counts the latencies of an endless stream on a logarithmic scale, with the worst, in bounded memory."""

import math

import numpy as np

SHORTEST = 1e-3  # ms, the end of the first bin
STEPS = 200  # Bins per factor of ten: a percentile is right to 1.2 %
DECADES = 9  # Number of factors of ten, from a microsecond to a thousand seconds


class Latencies:
    """A histogram of latencies. Attributes: count: number of latencies. worst: ms."""

    def __init__(self) -> None:
        self.count = 0
        self.worst = 0.0
        self._bins = np.zeros(STEPS * DECADES + 1, dtype=np.int64)

    def add(self, milliseconds: float) -> None:
        """Counts one latency."""
        place = math.ceil(STEPS * math.log10(max(milliseconds, SHORTEST) / SHORTEST))
        self._bins[min(place, len(self._bins) - 1)] += 1
        self.count += 1
        self.worst = max(self.worst, milliseconds)

    def percentile(self, share: float) -> float:
        """ms, latency that a share of all, from 0 to 1, does not exceed; NaN without any."""
        if self.count == 0:
            return math.nan
        place = int(np.searchsorted(np.cumsum(self._bins), max(math.ceil(share * self.count), 1)))
        return min(SHORTEST * 10.0 ** (place / STEPS), self.worst)

    def __str__(self) -> str:
        if self.count == 0:
            return "no lines"
        middle, p99, p999 = (self.percentile(share) for share in (0.5, 0.99, 0.999))
        return (
            f"latency of {self.count} lines: median {middle:.2f} ms, 99 % {p99:.2f} ms, 99.9 % {p999:.2f} ms, "
            f"worst {self.worst:.2f} ms"
        )
