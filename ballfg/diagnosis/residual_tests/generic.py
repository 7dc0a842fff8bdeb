"""Tests for remaining patterns of any cause, and locates them; tests the noise on tracks outside of the fit.

Each block of patterns is tested like a candidate effect, in its most visible directions; their choice does not depend
on the residuals. Where the halves differ, as with two balls thrown in turn, or predictions see something else than the
fit, the fit is good and predictions are not: `predicted_test`.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.diagnosis.fit.patterns import (
    DRIFT,
    EVERYWHERE,
    NEAR,
    PLAUSIBLE,
    Block,
    blocks_of,
    describe_drift,
    drift_block,
)
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.system import System
from ballfg.diagnosis.generic_test import ALARM, APART, PREDICTED, GenericTest
from ballfg.diagnosis.hypotheses.signatures import signatures_of
from ballfg.diagnosis.residual_tests.whiteness import whiteness
from ballfg.diagnosis.result import Errors
from ballfg.diagnosis.search.evaluation import MOST_FOR_NOISE
from ballfg.diagnosis.search.score import pattern_tests
from ballfg.tracks.noise import TrackNoise

TRACKS_PER_DIRECTION = 4
"""Number of tracks per tested direction of a block: their scatter must determine the directions' covariance."""
LEAST_INFORMATION = 1.0
"""Least information of a tested direction: its strength is known to the size of a pattern large in practice."""
MOST_SEEN = 95.0  # Percentile over the data in the words "up to"


@dataclass(frozen=True)
class _Test:
    """One test of one fit; p-value not corrected for their number. `quantities` are those of a block, else none.

    `cause` is a kind that explains all of the pattern, or empty.
    """

    kind: str
    quantities: tuple[str, ...]
    where: str
    p_value: float
    size: float
    cause: str = ""


def generic_tests(fit: Fit, reference: Fit | None = None, tracker: TrackNoise | None = None) -> tuple[GenericTest, ...]:
    """All tests of a fit, with p-values corrected for their number.

    Args:
        fit: of the model so far.
        reference: the fit of the declared model, for shares; None: `fit` itself.
        tracker: found noise of a tracker with errors that are not white.
    Returns: the tests, the least probable first.
    """
    tests = _tests_of(fit, tracker)
    first = tests if reference is None or reference is fit else _tests_of(reference, tracker)
    sizes = {(test.kind, test.quantities): test.size for test in first}
    found = []
    for test in tests:
        whole = max(test.size, sizes.get((test.kind, test.quantities), 0.0))
        share = test.size / whole if whole > 0.0 else 0.0
        found.append(GenericTest(test.cause or test.kind, test.where, min(1.0, len(tests) * test.p_value), share))
    return tuple(sorted(found, key=lambda t: t.p_value))


def _tests_of(fit: Fit, tracker: TrackNoise | None) -> list[_Test]:
    system = fit.linearised
    drifting = drift_block(fit, system)
    drift = whiteness(fit, system, tracker)
    apart = _apart(fit, system, tracker) if drift.p_value < ALARM else ""
    tests = _block_tests(fit, system, [*blocks_of(fit), *([] if drifting is None else [drifting])])
    tests.append(_Test("time", (), apart or drift.where, drift.p_value, drift.drift**2, APART if apart else ""))
    return tests


def _apart(fit: Fit, system: System, tracker: TrackNoise | None) -> str:
    """What differs from track to track if that leaves nothing of a drift along the tracks, in words; else empty."""
    own = [number for number, name in enumerate(fit.problem.free) if name not in fit.problem.deviations]
    if not own or whiteness(fit, system, tracker, own).p_value < ALARM:
        return ""
    most = min(own, key=lambda number: whiteness(fit, system, tracker, [number]).drift)
    return f"{APART}: coefficients differ from each track to the next, {list(fit.problem.free)[most]} most of all"


def _block_tests(fit: Fit, system: System, blocks: list[Block]) -> list[_Test]:
    """Tests of all visible blocks."""
    signatures = signatures_of(fit, system, np.concatenate([block.columns for block in blocks], axis=-1))
    efficient = signatures.efficient()
    information, score, at = efficient.total, efficient.score.sum(axis=0), 0
    seen: list[tuple[Block, str]] = []
    directions: list[Array] = []
    for block in blocks:
        own = slice(at, at := at + block.columns.shape[-1])
        values, vectors = np.linalg.eigh(information[own, own])
        shown = np.flatnonzero(values >= LEAST_INFORMATION)[::-1][: max(1, signatures.tracks // TRACKS_PER_DIRECTION)]
        if len(shown):
            turn = np.zeros((len(score), len(shown)))
            turn[own] = vectors[:, shown]  # the most visible directions of the block's columns
            strengths = np.linalg.solve(information[own, own] + np.eye(len(values)), score[own])
            strengths = strengths.reshape(len(block.axes), -1)
            words = describe_drift(fit, block, strengths) if block.kind == DRIFT else where(block, strengths)
            seen.append((block, words))
            directions.append(turn)
    noise = float((fit.noise.position**2).mean())  # shares use residuals that are not whitened
    return [
        _Test(block.kind, block.quantities, words, p.p_value, noise * max(0.0, p.explained - p.rank))
        for (block, words), p in zip(seen, pattern_tests(signatures, directions), strict=True)
    ]


def where(block: Block, strengths: Array) -> str:
    """The place of a block's pattern, in words; strengths: (3, f) of its columns, in units of plausible sizes."""
    pattern = PLAUSIBLE[block.kind] * strengths @ block.values.T  # (3, m)
    axis = int(np.argmax((pattern**2).mean(axis=1)))
    share = strengths[axis] ** 2 * (block.values**2).mean(axis=0)
    name = block.quantities[int(np.argmax(share))]
    most = 100.0 if name in NEAR else MOST_SEEN  # few samples are near a contact, and nearness has a bound
    size = float(np.percentile(np.abs(pattern[axis]), most))
    what, unit, factor = {
        "flight": ("acceleration", "m/s^2", 1.0),
        "contact": ("velocity after a contact", "m/s", 1.0),
        "measurement": ("error of position", "mm", 1e3),
    }[block.kind]
    depends = f"is off {EVERYWHERE}" if name == EVERYWHERE else f"depends on {name}"
    return f"{block.kind}: {what} {block.axes[axis]} {depends}, up to {factor * size:.2g} {unit}"


NONE: Final = GenericTest(
    PREDICTED, f"{PREDICTED}: errors of the held-out tracks are not larger than the model's noise expects", 1.0, 0.0
)


def predicted_test(before: Errors, after: Errors, fitted: int) -> GenericTest:
    """The test for squared errors beyond those that a model with its noise expects, by the scatter between tracks.

    Args:
        before, after: errors of the declared and of the corrected model on the held-out half.
        fitted: number of tracks of the search half. The noise is known as well as so many tracks tell it.
    Returns: the test; its share is that of the declared model's squared error beyond the corrected model's noise.
    """
    judged, told = len(after.by_track), min(fitted, MOST_FOR_NOISE)
    excess, sigma = after.nis - 1.0, after.nis_error * math.sqrt(1.0 + judged / told)
    if not (excess > 0.0 and sigma > 0.0 and judged > 1 and told > 1):
        return NONE
    from scipy import stats  # it takes half a second to import

    p_value = float(stats.t.sf(excess / sigma, min(judged, told) - 1))
    left = after.prediction_rmse_mm**2 * excess / after.nis
    whole = max(left, before.prediction_rmse_mm**2 - after.prediction_rmse_mm**2 + left)
    times = math.sqrt(after.nis)
    where = f"{PREDICTED}: errors of the held-out tracks are {times:.2g} times those that the model's noise expects"
    return replace(NONE, where=where, p_value=p_value, share=left / whole)
