"""Counts the tracks of a command by their status, and ends it where some could not be estimated."""

import sys
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import typer

from ballfg.cli.start import NOT_ESTIMATED
from ballfg.progress import counted, print_notes

if TYPE_CHECKING:
    from ballfg.estimation import Status

MOST_FAILURES = 10  # Number of failed tracks that are named; further ones are counted
MOST_DOUBTS = 3  # Number of tracks whose doubts are printed; further ones are counted


@dataclass
class Outcome:
    """Counts of tracks by their status: sums, so that memory does not grow with their number."""

    statuses: Counter[str] = field(default_factory=Counter)
    doubts: list[str] = field(default_factory=list)
    doubtful: int = 0
    failed: dict[str, str] = field(default_factory=dict)
    failures: int = 0
    outside: int = 0
    far: int = 0
    shares: float = 0.0

    def add(self, name: str, status: "Status", notes: Iterable[str], outside: float | None) -> None:
        """Counts a track.

        Args:
            name: of the track.  status: of its estimate.  notes: doubts about its frame.
            outside: share of it outside of a network's training data, 0 to 1; None without a network.
        """
        from ballfg.checks import shown

        self.statuses[status.value] += 1
        if status.failed:
            self.failures += 1
            if self.failures <= MOST_FAILURES:
                self.failed[name] = status.value
        for note in notes:
            self.doubtful += 1
            if self.doubtful <= MOST_DOUBTS:
                self.doubts.append(f"track {shown(name)}: {note}")
        if outside is not None:
            self.outside, self.far, self.shares = self.outside + 1, self.far + (outside > 0.5), self.shares + outside

    def print(self) -> None:
        """Prints the counts of tracks by status, most first, and on stderr the first doubts about their frame."""
        for text, number in self.statuses.most_common():
            print(f"  {counted(number, 'track')}: {text}")
        print_notes(self.doubts)
        if self.doubtful > MOST_DOUBTS:
            more = self.doubtful - MOST_DOUBTS
            print_notes([f"the same doubts about {counted(more, 'more track')}"])

    def end(self) -> None:
        """Ends a command whose output is complete, with a table of the tracks that could not be estimated.

        Raises: typer.Exit: with the status `NOT_ESTIMATED`, if there are any.
        """
        if not self.failures:
            return
        print(f"ballfg: {self.failures} of {self.statuses.total()} tracks could not be estimated:", file=sys.stderr)
        width = max(map(len, self.failed))
        for name, why in self.failed.items():
            print(f"  {name.ljust(width)}  {why.split(';')[0].split('. ')[0]}", file=sys.stderr)
        if self.failures > len(self.failed):
            print(f"  and {self.failures - len(self.failed)} more", file=sys.stderr)
        raise typer.Exit(NOT_ESTIMATED)

    def print_outside(self) -> None:
        """Prints the share of the tracks outside of a network's training data; nothing without a network."""
        if self.outside:
            mean, text = 100 * self.shares / self.outside, "outside of the network's training data"
            print(f"  {text}: {mean:.0f} % on average, {counted(self.far, 'track')} for the greater part")
