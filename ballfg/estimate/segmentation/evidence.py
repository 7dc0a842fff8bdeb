"""Evidence: what a sample says about each hypothesis, and which hypotheses are worth keeping."""

from __future__ import annotations

import numpy as np

from ballfg.estimate.segmentation.bank import Bank, FloatArray
from ballfg.estimate.segmentation.events import Event, EventKind
from ballfg.estimate.segmentation.scene import Scene
from ballfg.estimate.segmentation.settings import SegmentationSettings

GOOD, WIDE, OUTLIER = range(3)
"""The components of the noise."""


def log_shares(settings: SegmentationSettings) -> FloatArray:
    """(3,) log prior of the noise components, in the order of `GOOD`, `WIDE`, `OUTLIER`."""
    wide, out = settings.wide_share, settings.outlier_share
    return np.log(np.array([1.0 - wide - out, wide, out]))


def update(bank: Bank, position: FloatArray, sigma: FloatArray, scene: Scene, sample: int, time: float) -> FloatArray:
    """Takes a sample into every hypothesis: its most likely noise component, the Kalman update, the evidence.

    Constants that all hypotheses share (3/2 log 2 pi) are left out of the score. The arrays of the bank are replaced,
    not changed, so that the bank it was copied from stays valid.

    Args:
        bank: predicted hypotheses; changed.
        position: (3,) m.
        sigma: (3,) m, stated noise.
        scene: settings.
        sample: index of the sample.
        time: s, its stamp.
    Returns: (h,) squared whitened innovation, as of a good sample.
    """
    settings = scene.settings
    noise = sigma**2 + (settings.stamp_jitter * bank.mean[:, :, 1]) ** 2
    innovation = position - bank.mean[:, :, 0]
    squared = innovation**2
    known = bank.cov[:, :, 0, 0]
    S = np.empty((3, *squared.shape))
    S[GOOD] = known + noise
    S[WIDE] = known + settings.wide_factor**2 * noise
    S[OUTLIER] = settings.outlier_spread**2
    whitened = squared / S
    evidence = log_shares(settings)[:, None] - 0.5 * (whitened + np.log(S)).sum(-1)
    component = evidence.argmax(0)
    rows = np.arange(len(component))
    gain = bank.cov[..., 0] / S[component, rows][..., None]  # (h, axis, 3)
    gain[component == OUTLIER] = 0.0
    bank.mean = bank.mean + gain * innovation[..., None]
    bank.cov = bank.cov - gain[..., :, None] * bank.cov[..., 0, None, :]
    bank.score = bank.score + evidence[component, rows]
    bank.age = bank.age + (component != OUTLIER)
    unusual = component.nonzero()[0]
    if len(unusual):
        bank.tips = bank.tips.copy()
        for row in unusual:
            kind = EventKind.WIDE if component[row] == WIDE else EventKind.OUTLIER
            bank.add_event(int(row), Event(kind, sample, time))
    return whitened[GOOD].sum(-1)


def prune(bank: Bank, settings: SegmentationSettings) -> Bank:
    """The hypotheses worth keeping, best first.

    Hypotheses whose last event is old predict the same from now on if they are in the same mode, so the best of them
    stands for all (the Viterbi step).
    """
    if len(bank) == 1:
        return bank
    order = np.argsort(-bank.score, kind="stable")
    score, surface = bank.score[order], bank.surface[order]
    keep = score >= score[0] - settings.margin
    mature = keep & (bank.age[order] >= settings.mature)
    for mode in set(surface[mature].tolist()):
        keep[(mature & (surface == mode)).nonzero()[0][1:]] = False
    return bank.take(order[keep][: settings.most])
