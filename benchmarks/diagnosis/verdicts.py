"""Decides whether a diagnosis was right, by the names accepted for the planted effects."""

from collections.abc import Iterable

from ballfg.benchmarks.diagnosis.cases import Recording
from ballfg.benchmarks.diagnosis.effects import PLANTS
from ballfg.benchmarks.diagnosis.record import Found, Record
from ballfg.diagnosis.hypotheses.hypothesis import TWINS
from ballfg.diagnosis.result import Outcome, Verdict

LARGEST_GROUP = 3  # Effects that a diagnosis may name together and still be right


def named(record: Record, planted: Iterable[str]) -> bool:
    """True if the first finding is a planted effect, or one of a small group of indistinguishable ones with it."""
    return bool(record.found) and is_one_of(record.found[0], planted)


def is_one_of(found: Found, planted: Iterable[str]) -> bool:
    """True if a finding is a planted effect, or in a small group with one."""
    group = (found.name, *found.alike)
    return found.name in planted or (len(group) <= LARGEST_GROUP and not set(group).isdisjoint(planted))


def honest(record: Record, name: str) -> bool:
    """True for an effect with equals if its group is named, however large, or it is reported as invisible."""
    if record.found:
        return name in (record.found[0].name, *record.found[0].alike)
    entries = {name, *(listed for listed, twins in TWINS.items() if name in twins)}  # exact twins are one entry
    standings = [ranked.standing for ranked in record.rounds[-1] if ranked.name in entries] if record.rounds else []
    return standings == [Outcome.INVISIBLE.value]


def right(record: Record, planted: tuple[str, ...]) -> bool:
    """True by `honest` for an effect with equals, else by `named`."""
    if len(planted) == 1 and PLANTS[planted[0]].hidden:
        return honest(record, planted[0])
    return named(record, planted)


def complete(record: Record, planted: tuple[str, ...]) -> bool:
    """True if every planted effect is the whole or a part of some finding, and no finding is anything else."""
    every = all(any(is_one_of(found, (name,)) for found in record.found) for name in planted)
    return every and all(is_one_of(found, planted) for found in record.found)


def false_names(record: Record, recording: Recording) -> list[str]:
    """False names in a dataset whose model is complete; jitter of the stamps is false only where there is none."""
    return [found.name for found in record.found if found.name != "stamp_jitter" or not recording.jitter]


def alarmed(record: Record, recording: Recording) -> bool:
    """True if a complete model was reported to lack something, by name or without one."""
    return bool(false_names(record, recording)) or record.verdict == Verdict.UNEXPLAINED.value
