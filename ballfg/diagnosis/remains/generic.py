"""Tests for any pattern that is left, whatever its cause, and where it lives.

Each block of patterns (module `patterns`) is tested as a candidate effect is: by the scores of its columns, with states
and declared coefficients projected out and tracks as independent units. Of a large block only the directions that the
data show best are tested; the residuals have no part in choosing them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.remains.drift import DRIFT, describe_drift, drift_block
from ballfg.diagnosis.remains.label_check import LABEL, LabelCheck, check_labels
from ballfg.diagnosis.remains.patterns import EVERYWHERE, PLAUSIBLE, Block, blocks_of
from ballfg.diagnosis.remains.whiteness import Whiteness, whiteness
from ballfg.diagnosis.result import Array, GenericTest
from ballfg.diagnosis.search.score import Pattern, pattern_tests
from ballfg.diagnosis.search.signatures import Signatures, signatures_of

ALARM = 0.005
"""Probability that any of the tests of a fit that lacks nothing raises an alarm: p-values below it are alarms."""
TRACKS_PER_DIRECTION = 4
"""Tracks for each direction of a block that is tested: their scatter must tell the directions' covariance."""
LEAST_INFORMATION = 1.0
"""Of a direction that is tested: the data tell its strength to the size of a pattern that is large in practice."""
MOST_SEEN = 95.0
"""Percentile over the data that "up to" means."""


@dataclass(frozen=True)
class _Tested:
    """The outcome for one block: where it lives, and the test in its leading directions."""

    block: Block
    where: str
    pattern: Pattern


@dataclass(frozen=True)
class _Examined:
    """All tests of one fit."""

    found: list[_Tested]
    whiteness: Whiteness
    labels: LabelCheck | None

    def of_block(self, block: Block) -> _Tested | None:
        """The test of a block of the same quantities."""
        same = [t for t in self.found if (t.block.kind, t.block.quantities) == (block.kind, block.quantities)]
        return same[0] if same else None


def generic_tests(fit: Fit, reference: Fit | None = None) -> tuple[GenericTest, ...]:
    """All tests of a fit, p-values corrected for their number.

    Args:
        fit: of the model so far.
        reference: the fit of the declared model, to which shares refer; None: `fit` itself.

    Returns:
        The tests, the least probable first.
    """
    now = _examine(fit)
    start = now if reference is None or reference is fit else _examine(reference)
    quieter = 1.0 if reference is None else _noise_square(fit) / _noise_square(reference)
    count = len(now.found) + 1 + (now.labels is not None)
    tests = [_block_test(tested, start.of_block(tested.block), quieter, count) for tested in now.found]
    tests.append(_time_test(now.whiteness, start.whiteness, count))
    if now.labels is not None and start.labels is not None:
        tests.append(_label_test(now.labels, start.labels, count))
    return tuple(sorted(tests, key=lambda t: t.p_value))


def _noise_square(fit: Fit) -> float:
    """Mean square of the noise's scale. It turns shares of whitened residuals into shares of plain ones."""
    return float((fit.noise.position**2).mean())


def _examine(fit: Fit) -> _Examined:
    system = fit.linearised()
    drifting = drift_block(fit, system)
    blocks = [*blocks_of(fit), *([] if drifting is None else [drifting])]
    signatures = signatures_of(fit, system, np.concatenate([block.columns for block in blocks], axis=-1))
    return _Examined(_tested(fit, signatures, blocks), whiteness(fit, system), check_labels(fit, system))


def _tested(fit: Fit, signatures: Signatures, blocks: list[Block]) -> list[_Tested]:
    """Every block that the data show at all."""
    efficient = signatures.efficient()
    information = efficient.total
    score, at = efficient.score.sum(axis=0), 0
    seen: list[tuple[Block, str]] = []
    directions: list[Array] = []
    for block in blocks:
        own = slice(at, at := at + block.columns.shape[-1])
        turn = _leading(information[own, own], signatures.tracks, own, len(score))
        if turn.shape[1]:
            strengths = np.linalg.solve(information[own, own] + np.eye(own.stop - own.start), score[own])
            strengths = strengths.reshape(len(block.axes), -1)
            words = describe_drift(fit, block, strengths) if block.kind == DRIFT else where(block, strengths)
            seen.append((block, words))
            directions.append(turn)
    patterns = pattern_tests(signatures, directions)
    return [_Tested(*of, pattern) for of, pattern in zip(seen, patterns, strict=True)]


def _leading(information: Array, tracks: int, own: slice, count: int) -> Array:
    """(count, r) the directions of a block's columns that the data show best, among all `count` columns."""
    values, vectors = np.linalg.eigh(information)
    most = max(1, tracks // TRACKS_PER_DIRECTION)
    shown = np.flatnonzero(values >= LEAST_INFORMATION)[::-1][:most]
    turn = np.zeros((count, len(shown)))
    turn[own] = vectors[:, shown]
    return turn


def where(block: Block, strengths: Array) -> str:
    """The place of a block's pattern, in words; strengths: (3, f) of its columns, in units of plausible sizes."""
    pattern = PLAUSIBLE[block.kind] * strengths @ block.values.T  # (3, m)
    axis = int(np.argmax((pattern**2).mean(axis=1)))
    share = strengths[axis] ** 2 * (block.values**2).mean(axis=0)
    name = block.quantities[int(np.argmax(share))]
    size = float(np.percentile(np.abs(pattern[axis]), MOST_SEEN))
    what, unit, factor = {
        "flight": ("acceleration", "m/s^2", 1.0),
        "contact": ("velocity after a contact", "m/s", 1.0),
        "measurement": ("error of position", "mm", 1e3),
    }[block.kind]
    depends = f"is off {EVERYWHERE}" if name == EVERYWHERE else f"depends on {name}"
    return f"{block.kind}: {what} {block.axes[axis]} {depends}, up to {factor * size:.2g} {unit}"


def _block_test(tested: _Tested, start: _Tested | None, quieter: float, count: int) -> GenericTest:
    left = quieter * max(0.0, tested.pattern.explained - tested.pattern.rank)
    first = max(left, 0.0 if start is None else start.pattern.explained - start.pattern.rank)
    p_value, share = min(1.0, count * tested.pattern.p_value), left / first if first > 0.0 else 0.0
    return GenericTest(tested.block.kind, tested.where, p_value, share)


def _time_test(now: Whiteness, start: Whiteness, count: int) -> GenericTest:
    whole = max(now.drift, start.drift)
    where = f"time: samples within {1e3 * now.reach:.0f} ms err alike, by {1e3 * now.drift:.2g} mm"
    share = (now.drift / whole) ** 2 if whole > 0.0 else 0.0
    return GenericTest("time", where, min(1.0, count * now.p_value), share)


def _label_test(labels: LabelCheck, start: LabelCheck, count: int) -> GenericTest:
    now, first = len(labels.contradicted), len(start.contradicted)
    return GenericTest(LABEL, labels.where, min(1.0, count * labels.p_value), now / max(now, first) if now else 0.0)
