"""Whether a diagnosis was right: which names are accepted for the planted effects."""

from collections.abc import Iterable

from ballfg.benchmarks.diagnosis.cases import Recording
from ballfg.benchmarks.diagnosis.effects import PLANTS
from ballfg.benchmarks.diagnosis.record import Found, Record
from ballfg.diagnosis.result import Outcome, Verdict
from ballfg.diagnosis.search.hypothesis import TWINS

LARGEST_GROUP = 3
"""Effects that a diagnosis may name together and still be right."""


def named(record: Record, planted: Iterable[str]) -> bool:
    """Whether the first finding is a planted effect, or one that is said to look like it in a group that is small."""
    return bool(record.found) and is_one_of(record.found[0], planted)


def is_one_of(found: Found, planted: Iterable[str]) -> bool:
    """Whether a finding is a planted effect, or in a small group with one."""
    group = (found.name, *found.alike)
    return found.name in planted or (len(group) <= LARGEST_GROUP and not set(group).isdisjoint(planted))


def honest(record: Record, name: str) -> bool:
    """The same for an effect that hides: its group is named, however large, or it is said to be invisible."""
    if record.found:
        return name in (record.found[0].name, *record.found[0].alike)
    entries = {name, *(listed for listed, twins in TWINS.items() if name in twins)}  # exact twins are one entry
    standings = [ranked.standing for ranked in record.rounds[-1] if ranked.name in entries] if record.rounds else []
    return standings == [Outcome.INVISIBLE.value]


def right(record: Record, planted: tuple[str, ...]) -> bool:
    """`honest` for an effect that hides, else `named`."""
    if len(planted) == 1 and PLANTS[planted[0]].hidden:
        return honest(record, planted[0])
    return named(record, planted)


def complete(record: Record, planted: tuple[str, ...]) -> bool:
    """Whether every planted effect is the whole or a part of some finding, and no finding is anything else."""
    every = all(any(is_one_of(found, (name,)) for found in record.found) for name in planted)
    return every and all(is_one_of(found, planted) for found in record.found)


def false_names(record: Record, recording: Recording) -> list[str]:
    """Names found in a dataset whose model lacks nothing; jitter of the stamps is one only where there is none."""
    return [found.name for found in record.found if found.name != "stamp_jitter" or not recording.jitter]


def alarmed(record: Record, recording: Recording) -> bool:
    """Whether a dataset whose model lacks nothing was said to lack something, by name or without one."""
    return bool(false_names(record, recording)) or record.verdict == Verdict.UNEXPLAINED.value
