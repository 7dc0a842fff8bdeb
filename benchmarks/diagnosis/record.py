"""Keeps the record of a diagnosis as a JSON file for later runs, and decides whether it was right."""

import hashlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from importlib import metadata

from ballfg.benchmarks.diagnosis.cases import PLANTS, Case, Recording
from ballfg.benchmarks.results import Kept
from ballfg.diagnosis.hypotheses.hypothesis import TWINS
from ballfg.diagnosis.result import Candidate, Diagnosis, Errors, Outcome, Value, Verdict

RANKED = 8  # Leading candidates of a round that are kept, beside those planted


@dataclass(frozen=True)
class Found:
    """A finding: its name, indistinguishable effects, its evidence, and coefficients with their sigmas."""

    name: str
    alike: tuple[str, ...]
    p_value: float
    delta_bic: float
    parameters: Mapping[str, tuple[float, float | None]]


@dataclass(frozen=True)
class Ranked:
    """A candidate of a round: its explained residual, its evidence, its outcome, coefficients with their sigmas."""

    name: str
    explained: float
    p_value: float
    delta_bic: float | None
    standing: str
    estimate: Mapping[str, tuple[float, float | None]] = field(default_factory=dict)


@dataclass(frozen=True)
class Record(Kept):
    """A finished case.

    Attributes:
        verdict: as in the report.
        found: findings in order.  rounds: leading candidates of each round, best first, and those planted.
        errors: mm, prediction error on the judging half: `before`, `after`, of the true model `true`, and where there
            is a fallback, with it (`fallback`, the one after) and with named effects only (`named`).
        patterns: p-values of the tests for remaining patterns, by their place.
        tracks, judged: numbers of tracks in the dataset and on the judging half.
        seconds: of the diagnosis, wall clock.  strengths: of the change that measured tracks underwent, by coefficient.
        probabilities: stated, that an effect is there, by its name.
    """

    verdict: str
    found: tuple[Found, ...]
    rounds: tuple[tuple[Ranked, ...], ...]
    errors: Mapping[str, float]
    patterns: Mapping[str, float]
    tracks: int
    judged: int
    seconds: float
    strengths: Mapping[str, float] = field(default_factory=dict)
    probabilities: Mapping[str, float] = field(default_factory=dict)


def record_of(case: Case, digest: str, diagnosis: Diagnosis, true: Errors | None, seconds: float) -> Record:
    """The kept part of a diagnosis."""
    errors = {"before": diagnosis.before, "after": diagnosis.after}
    left = diagnosis.unexplained
    if left.fallback is not None:
        errors |= {"named": left.fallback.before, "fallback": left.fallback.after}
    if true is not None:
        errors["true"] = true
    return Record(
        digest=digest,
        verdict=diagnosis.verdict.value,
        found=tuple(
            Found(f.name, tuple(f.indistinguishable_from), float(f.p_value), float(f.delta_bic), _values(f.parameters))
            for f in diagnosis.findings
        ),
        rounds=tuple(_leading(listed, case.planted) for listed in diagnosis.rounds),
        errors={name: float(one.prediction_rmse_mm) for name, one in errors.items()},
        patterns={test.where: float(test.p_value) for test in left.tests},
        tracks=diagnosis.tracks_found_on + diagnosis.tracks_judged_on,
        judged=diagnosis.tracks_judged_on,
        seconds=seconds,
        probabilities=dict(diagnosis.probabilities),
    )


def _values(values: Mapping[str, Value]) -> dict[str, tuple[float, float | None]]:
    known = {name: v for name, v in values.items() if math.isfinite(v.value)}
    return {name: (float(v.value), float(v.sigma) if math.isfinite(v.sigma) else None) for name, v in known.items()}


def _leading(listed: tuple[Candidate, ...], planted: tuple[str, ...]) -> tuple[Ranked, ...]:
    kept = [c for place, c in enumerate(listed) if place < RANKED or c.name in planted]
    bic = [None if c.delta_bic is None else float(c.delta_bic) for c in kept]
    return tuple(
        Ranked(c.name, float(c.explained), float(c.p_value), delta, c.outcome.value, _values(c.estimate))
        for c, delta in zip(kept, bic, strict=True)
    )


def case_digest(case: Case) -> str:
    """Digest of a case's settings: the planted effects and the recording, or the measured files."""
    digest = hashlib.sha256(repr((metadata.version("ballfg"), replace(case, data=None))).encode())
    if case.data is not None:
        for path in sorted(case.data.iterdir()):
            if path.is_file():
                digest.update(path.name.encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()


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
