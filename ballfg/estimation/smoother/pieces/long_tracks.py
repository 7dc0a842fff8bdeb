"""Smooths long tracks in pieces and all others at once; the registry names this estimator "smoother"."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from ballfg.estimation.result import Estimate
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.tracks import Track

LONG: Final = 10_000
"""Number of samples from which a track is smoothed in pieces that are then joined (docs/derivations/long_tracks.md)."""


class PiecewiseSmoother(Smoother):
    """The smoother, with pieces around it for long tracks.

    Args: as for `Smoother`.
    """

    def is_long(self, track: Track) -> bool:
        """True if a track is smoothed in pieces; with changing stamps or GTSAM's solver it is smoothed at once."""
        return len(track) >= LONG and not self.settings.time_offsets and self.settings.solver != "gtsam"

    def in_pieces(self, track: Track) -> Estimate | None:
        """The estimate of a long track; None for any other, or if its pieces cannot be joined."""
        if not self.is_long(track):
            return None
        from ballfg.estimation.smoother.pieces.whole import in_pieces  # most tracks do not need it

        joined = in_pieces(self, track.since_first())
        return None if joined is None else joined.dated(track.times)

    def in_sections(self, track: Track) -> Iterator[Estimate]:
        """The estimate of a long track section by section, of any other as a whole."""
        if self.is_long(track):
            from ballfg.estimation.smoother.pieces.whole import sections

            found = sections(self, self.prepared(track).since_first())
            if found is not None:
                begin = 0
                for part in found:
                    yield part.dated(track.times[begin : begin + len(part)], float(track.times[0]))
                    begin += len(part)
                return
        yield self.estimate(track)
