"""Is anything left that has a pattern, and where does it live? Tests that need no name for it.

Each block of patterns (module `patterns`) is tested as a candidate effect is: scores of its columns with
states and declared coefficients projected out, tracks as independent units. Of a large block only the directions that
the data show best are tested, chosen before anything is known of the residuals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ballfg.diagnosis.fit.problem import Fit, common_precision, linearise
from ballfg.diagnosis.fit.system import System, by_track
from ballfg.diagnosis.remains.clustered import Pattern, judge_patterns
from ballfg.diagnosis.remains.drift import RECORDING, drift, recording_block
from ballfg.diagnosis.remains.patterns import EVERYWHERE, PLAUSIBLE, UNIT, Block, blocks_of
from ballfg.diagnosis.remains.whiteness import Whiteness, whiteness
from ballfg.diagnosis.result import GenericTest
from ballfg.diagnosis.search.label_check import LABEL, LabelCheck, check_labels
from ballfg.diagnosis.search.signatures import Signatures

ALARM = 0.005
"""Probability that any of the tests of a fit that lacks nothing raises an alarm: p-values below it are alarms."""
TRACKS_PER_DIRECTION = 4
"""Tracks for each direction of a block that is tested: their scatter must tell the directions' covariance."""
LEAST_INFORMATION = 1.0
"""Of a direction that is tested: the data tell its strength to the size of a pattern that is large in practice."""
MOST_SEEN = 95.0
"""Percentile over the data that "up to" means."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _Tested:
    """The outcome for one block: where it lives, and the test in its leading directions."""

    block: Block
    where: str
    pattern: Pattern


def generic_tests(fit: Fit, reference: Fit | None = None) -> tuple[GenericTest, ...]:
    """All tests of a fit, p-values corrected for their number, the least probable first.

    Args: reference: the fit at the start, to which shares refer; None: this one.
    """
    now = _examine(fit)
    start = now if reference is None or reference is fit else _examine(reference)
    quieter = 1.0 if reference is None else _noise_square(fit) / _noise_square(reference)
    count = len(now.found) + 1 + (now.labels is not None)
    tests = [_generic(tested, _of_block(start.found, tested.block), quieter, count) for tested in now.found]
    tests.append(_time(now.drift, start.drift, count))
    if now.labels is not None and start.labels is not None:
        tests.append(_label(now.labels, start.labels, count))
    return tuple(sorted(tests, key=lambda t: t.p_value))


def _noise_square(fit: Fit) -> float:
    """Mean square of the noise's scale, by which residuals are whitened: shares are of residuals that are not."""
    return float((fit.noise.position**2).mean())


@dataclass(frozen=True)
class _Examined:
    """All tests of one fit."""

    found: list[_Tested]
    drift: Whiteness
    labels: LabelCheck | None


def _examine(fit: Fit) -> _Examined:
    system = linearise(fit.problem, fit.unknowns, fit.noise, fit.predicted)
    drifting = recording_block(fit, system)
    blocks = [*blocks_of(fit), *([] if drifting is None else [drifting])]
    columns = np.concatenate((system.by_common, *(block.columns for block in blocks)), axis=-1)
    whole = System(system.residual, system.by_start, columns)
    gram = by_track(whole.eliminated().gram, fit.problem.stretches.track)
    signatures = Signatures(gram, common_precision(fit.problem), system.by_common.shape[-1])
    return _Examined(_tested(fit, signatures, blocks), whiteness(fit, system), check_labels(fit, system))


def _tested(fit: Fit, signatures: Signatures, blocks: list[Block]) -> list[_Tested]:
    """Every block that the data show at all."""
    efficient = signatures.efficient()
    information = efficient.total
    score, at = efficient.score.sum(axis=0), 0
    seen: list[tuple[Block, str]] = []
    directions: list[Array] = []
    for block in blocks:
        own = slice(at, at + block.columns.shape[-1])
        at = own.stop
        turn = _leading(information[own, own], signatures.tracks, own, len(score))
        if turn.shape[1]:
            strengths = np.linalg.solve(information[own, own] + np.eye(own.stop - own.start), score[own])
            strengths = strengths.reshape(len(block.axes), -1)
            words = drift(fit, block, strengths) if block.kind == RECORDING else where(block, strengths)
            seen.append((block, words))
            directions.append(turn)
    patterns = judge_patterns(signatures, directions)
    return [_Tested(*of, pattern) for of, pattern in zip(seen, patterns, strict=True)]


def _leading(information: Array, tracks: int, own: slice, count: int) -> Array:
    """(count, r) the directions of a block's columns that the data show best, among all `count` columns."""
    values, vectors = np.linalg.eigh(information)
    most = max(1, tracks // TRACKS_PER_DIRECTION)
    shown = np.flatnonzero(values >= LEAST_INFORMATION)[::-1][:most]
    turn = np.zeros((count, len(shown)))
    turn[own] = vectors[:, shown]
    return turn


def _of_block(found: list[_Tested], block: Block) -> _Tested | None:
    same = [t for t in found if (t.block.kind, t.block.quantities) == (block.kind, block.quantities)]
    return same[0] if same else None


def _generic(tested: _Tested, start: _Tested | None, quieter: float, count: int) -> GenericTest:
    left = quieter * max(0.0, tested.pattern.explained - tested.pattern.rank)
    first = max(left, 0.0 if start is None else start.pattern.explained - start.pattern.rank)
    return GenericTest(
        name=tested.block.kind,
        where=tested.where,
        p_value=min(1.0, count * tested.pattern.p_value),
        share=left / first if first > 0.0 else 0.0,
    )


def where(block: Block, strengths: Array) -> str:
    """In words, where a block's pattern lives.

    Args: strengths: (3, f) of its columns, in units of what is plausible.
    """
    pattern = PLAUSIBLE[block.kind] * strengths @ block.values.T  # (3, m)
    axis = int(np.argmax((pattern**2).mean(axis=1)))
    share = strengths[axis] ** 2 * (block.values**2).mean(axis=0)
    name = block.quantities[int(np.argmax(share))]
    size = float(np.percentile(np.abs(pattern[axis]), MOST_SEEN))
    what = {"flight": "acceleration", "contact": "velocity after a contact", "measurement": "error of position"}
    depends = f"is off {EVERYWHERE}" if name == EVERYWHERE else f"depends on {name}"
    return f"{block.kind}: {what[block.kind]} {block.axes[axis]} {depends}, up to {_amount(block.kind, size)}"


def _amount(kind: str, size: float) -> str:
    return f"{1e3 * size:.2g} mm" if kind == "measurement" else f"{size:.2g} {UNIT[kind]}"


def _time(drift: Whiteness, start: Whiteness, count: int) -> GenericTest:
    whole = max(drift.drift, start.drift)
    return GenericTest(
        name="time",
        where=f"time: samples within {1e3 * drift.reach:.0f} ms err alike, by {1e3 * drift.drift:.2g} mm",
        p_value=min(1.0, count * drift.p_value),
        share=(drift.drift / whole) ** 2 if whole > 0.0 else 0.0,
    )


def _label(labels: LabelCheck, start: LabelCheck, count: int) -> GenericTest:
    now, first = len(labels.contradicted), len(start.contradicted)
    return GenericTest(
        name=LABEL,
        where=labels.where,
        p_value=min(1.0, count * labels.p_value),
        share=now / max(now, first) if now else 0.0,
    )
