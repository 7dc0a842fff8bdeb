"""Evidence: what a sample says about each hypothesis, and which hypotheses are worth keeping."""

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.segmentation.bank import Bank, IntArray, concatenate
from ballfg.estimation.segmentation.events import Event, EventKind
from ballfg.estimation.segmentation.kernels import (
    GOOD,
    NOT_QUIET,
    OUTLIER,
    WIDE,
    kept_rows,
    quiet_sample,
    weigh,
)
from ballfg.estimation.segmentation.scene import Scene
from ballfg.estimation.segmentation.settings import SegmentationSettings

NONE = np.zeros(0, dtype=np.int64)
"""No rows."""


def update(bank: Bank, position: Array, sigma: Array, scene: Scene, sample: int, time: float) -> tuple[Bank, Array]:
    """Takes a sample into every hypothesis: its most likely noise component, the Kalman update, the evidence.

    Where the prediction is too vague to tell, the sample is also tried as an outlier: those hypotheses come last.

    Args:
        bank: predicted hypotheses.
        position: (3,) m.
        sigma: (3,) m, stated noise.
        scene: settings.
        sample: index of the sample.
        time: s, its stamp.
    Returns: the updated hypotheses, and (h,) the squared whitened innovation, as of a good sample.
    """
    settings, h = scene.settings, len(bank)
    innovation, S = np.empty((h, 3)), np.empty((3, h, 3))
    evidence, surprise = np.empty((3, h)), np.empty(h)
    weigh(bank.mean, bank.cov, position, sigma, scene.numbers, scene.log_shares, innovation, S, evidence, surprise)
    component, rows, source = evidence.argmax(0), np.arange(len(bank)), bank
    best = evidence[component, rows]
    doubtful = _doubtful(bank.score, evidence[OUTLIER], best, settings)
    if len(doubtful):
        source = concatenate([bank, bank.take(doubtful)])
        rows = np.concatenate([rows, doubtful])
        component = np.concatenate([component, np.full(len(doubtful), OUTLIER)])
        innovation, best = innovation[rows], evidence[component, rows]
    gain = source.cov[..., 0] / S[component, rows][..., None]  # (h, axis, 3)
    components = component.tolist()
    used = component != OUTLIER
    if OUTLIER in components:
        gain[~used] = 0.0
    updated = Bank(
        mean=source.mean + gain * innovation[..., None],
        cov=source.cov - gain[..., :, None] * source.cov[..., 0, None, :],
        surface=source.surface,
        score=source.score + best,
        age=source.age + used,
        shift=source.shift,
        tips=source.tips.copy(),
    )
    for row, kind in enumerate(components):
        if kind != GOOD:
            updated.add_event(row, Event(EventKind.WIDE if kind == WIDE else EventKind.OUTLIER, sample, time))
    return updated, surprise[rows]


def _doubtful(score: Array, outlier: Array, best: Array, settings: SegmentationSettings) -> IntArray:
    """Rows that take the sample for the ball, but barely rather than for an outlier: later samples have to decide.

    That is so where little is known of where the ball is: its second sample, the first ones after a hit or a gap.
    Explanations that are far behind already are not multiplied.

    Args: score: (h,) before the sample.  outlier: (h,) evidence of the sample as an outlier.  best: (h,) as what fits.
    """
    margin = best - outlier
    if float(margin.min()) >= settings.outlier_doubt:
        return NONE
    doubtful = (margin > 0.0) & (margin < settings.outlier_doubt)
    doubtful &= score + outlier > (score + best).max() - settings.doubt_margin
    return doubtful.nonzero()[0]


def prune(bank: Bank, scene: Scene) -> Bank:
    """The hypotheses worth keeping, best first. A tracker that has been shifted for long is believed."""
    rows = np.empty(len(bank), dtype=np.int64)
    kept = bank.take(rows[: kept_rows(bank.score, bank.surface, bank.age, scene.numbers, rows)])
    kept.shift[kept.age >= scene.settings.mature] = 0.0
    return kept


def quiet_update(bank: Bank, position: Array, sigma: Array, dt: float, scene: Scene) -> Bank | None:
    """The hypotheses after the next sample, pruned, where nothing happens; None where something may.

    Args: bank: hypotheses, best first.  position, sigma: (3,) m.  dt: s, since the last sample.  scene: settings.
    """
    h = len(bank)
    mean, cov, score = np.empty_like(bank.mean), np.empty_like(bank.cov), np.empty(h)
    age, shift, rows = np.empty(h, dtype=np.int64), np.empty((h, 3)), np.empty(h, dtype=np.int64)
    now = (bank.mean, bank.cov, bank.surface, bank.score, bank.age, bank.shift)
    of_scene = (scene.numbers, scene.log_shares, scene.centres, scene.drift)
    n = quiet_sample(*now, dt, position, sigma, *of_scene, mean, cov, score, age, shift, rows)
    if n == NOT_QUIET:
        return None
    return Bank(mean[:n], cov[:n], bank.surface[:n], score[:n], age[:n], shift[:n], bank.tips[rows[:n]])
