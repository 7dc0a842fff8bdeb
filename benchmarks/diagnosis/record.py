"""Keeps the record of a diagnosis, names, evidence, errors and seconds, as a JSON file for later runs."""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from importlib import metadata
from pathlib import Path

from pydantic import TypeAdapter

from ballfg.benchmarks.diagnosis.cases import Case
from ballfg.benchmarks.resumable import read_record as read_any
from ballfg.benchmarks.resumable import write_record
from ballfg.diagnosis.result import Candidate, Diagnosis, Errors, Finding, Value

RANKED = 8
"""Leading candidates of a round that are kept, beside those planted."""


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
class Record:
    """A finished case.

    Attributes:
        digest: of the case: a record of another one does not count.
        verdict: as in the report.
        found: findings in order.
        rounds: leading candidates of each round, best first, and those planted.
        errors: mm, prediction error on the judging half: `before`, `after`, of the true model `true`, and where there
            is a fallback, with it (`fallback`, the one after) and with named effects only (`named`).
        patterns: p-values of the tests for remaining patterns, by their place.
        tracks, judged: numbers of tracks in the dataset and on the judging half.
        seconds: of the diagnosis, wall clock.
        strengths: of the change that measured tracks underwent, by coefficient.
        probabilities: stated, that an effect is there, by its name; empty where a diagnosis states none.
    """

    digest: str
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

    def save(self, path: Path) -> None:
        """Write the file whole or not at all."""
        write_record(path, asdict(self))


def read_record(path: Path, digest: str) -> Record | None:
    """The record in a file; None if there is no file, or one of another case.

    Raises: ValueError: if the file is no record.
    """
    return read_any(path, digest, TypeAdapter(Record).validate_python, "a finished case")


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
        found=tuple(_found(finding) for finding in diagnosis.findings),
        rounds=tuple(_leading(listed, case.planted) for listed in diagnosis.rounds),
        errors={name: float(one.prediction_rmse_mm) for name, one in errors.items()},
        patterns={test.where: float(test.p_value) for test in left.tests},
        tracks=diagnosis.tracks_found_on + diagnosis.tracks_judged_on,
        judged=diagnosis.tracks_judged_on,
        seconds=seconds,
        probabilities=_probabilities(diagnosis),
    )


def _found(finding: Finding) -> Found:
    alike = tuple(finding.indistinguishable_from)
    values = _values(finding.parameters)
    return Found(finding.name, alike, float(finding.p_value), float(finding.delta_bic), values)


def _values(values: Mapping[str, Value]) -> dict[str, tuple[float, float | None]]:
    known = {name: v for name, v in values.items() if math.isfinite(v.value)}
    return {name: (float(v.value), float(v.sigma) if math.isfinite(v.sigma) else None) for name, v in known.items()}


def _probabilities(diagnosis: Diagnosis) -> dict[str, float]:
    """Of findings, and of the last round's candidates; of one that is both, the finding's."""
    listed: list[Candidate | Finding] = [*(diagnosis.rounds[-1] if diagnosis.rounds else ()), *diagnosis.findings]
    stated = {one.name: getattr(one, "probability", None) for one in listed}
    return {name: float(value) for name, value in stated.items() if value is not None}


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
