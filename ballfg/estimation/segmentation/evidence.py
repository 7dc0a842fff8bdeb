"""Evidence: what a sample says about each hypothesis, and which hypotheses are worth keeping."""

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.segmentation.bank import Bank, IntArray, concatenate
from ballfg.estimation.segmentation.events import Event, EventKind
from ballfg.estimation.segmentation.scene import Scene
from ballfg.estimation.segmentation.settings import SegmentationSettings

GOOD, WIDE, OUTLIER = range(3)
"""The components of the noise, as in `Scene.log_shares`."""


NONE = np.zeros(0, dtype=np.int64)
"""No rows."""


def update(bank: Bank, position: Array, sigma: Array, scene: Scene, sample: int, time: float) -> tuple[Bank, Array]:
    """Takes a sample into every hypothesis: its most likely noise component, the Kalman update, the evidence.

    Where the prediction is too vague to tell, the sample is also tried as an outlier: those hypotheses come last.

    Constants that all hypotheses share (3/2 log 2 pi) are left out of the score.

    Args:
        bank: predicted hypotheses.
        position: (3,) m.
        sigma: (3,) m, stated noise.
        scene: settings.
        sample: index of the sample.
        time: s, its stamp.
    Returns: the updated hypotheses, and (h,) the squared whitened innovation, as of a good sample.
    """
    settings = scene.settings
    innovation = position - bank.mean[:, :, 0]
    known = bank.cov[:, :, 0, 0]
    S = np.empty((3, *innovation.shape))
    noise = settings.stamp_jitter * bank.mean[:, :, 1]
    noise *= noise
    noise += sigma * sigma
    np.add(known, noise, out=S[GOOD])
    noise *= settings.wide_factor**2
    np.add(known, noise, out=S[WIDE])
    np.add(known, settings.outlier_spread**2, out=S[OUTLIER])
    whitened = innovation * innovation / S
    evidence = scene.log_shares[:, None] - 0.5 * np.add.reduce(whitened + np.log(S), axis=-1)
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
    return updated, np.add.reduce(whitened[GOOD], axis=-1)[rows]


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


def prune(bank: Bank, settings: SegmentationSettings) -> Bank:
    """The hypotheses worth keeping, best first.

    Hypotheses whose last event is old predict the same from now on if they are in the same mode, so the best of them
    stands for all (the Viterbi step). A tracker that has been shifted for as long is believed.
    """
    if len(bank) == 1:
        if bank.age[0] >= settings.mature:
            bank.shift[:] = 0.0
        return bank
    order = np.argsort(-bank.score, kind="stable")
    score, surface = bank.score[order], bank.surface[order]
    keep = score >= score[0] - settings.margin
    mature = keep & (bank.age[order] >= settings.mature)
    for mode in set(surface[mature].tolist()):
        keep[(mature & (surface == mode)).nonzero()[0][1:]] = False
    kept = bank.take(order[keep][: settings.most])
    kept.shift[kept.age >= settings.mature] = 0.0
    return kept
