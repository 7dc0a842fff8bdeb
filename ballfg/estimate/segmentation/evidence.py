"""Evidence: what a sample says about each hypothesis, and which hypotheses are worth keeping."""

from __future__ import annotations

import numpy as np

from ballfg.estimate.segmentation.bank import Bank, FloatArray
from ballfg.estimate.segmentation.events import Event, EventKind
from ballfg.estimate.segmentation.scene import Scene
from ballfg.estimate.segmentation.settings import SegmentationSettings

GOOD, WIDE, OUTLIER = range(3)
"""The components of the noise, as in `Scene.log_shares`."""


def update(
    bank: Bank, position: FloatArray, sigma: FloatArray, scene: Scene, sample: int, time: float
) -> tuple[Bank, FloatArray]:
    """Takes a sample into every hypothesis: its most likely noise component, the Kalman update, the evidence.

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
    noise = sigma**2 + (settings.stamp_jitter * bank.mean[:, :, 1]) ** 2
    innovation = position - bank.mean[:, :, 0]
    known = bank.cov[:, :, 0, 0]
    S = np.empty((3, *innovation.shape))
    S[GOOD] = known + noise
    S[WIDE] = known + settings.wide_factor**2 * noise
    S[OUTLIER] = known + settings.outlier_spread**2
    whitened = innovation**2 / S
    evidence = scene.log_shares[:, None] - 0.5 * (whitened + np.log(S)).sum(-1)
    component = evidence.argmax(0)
    rows = np.arange(len(component))
    gain = bank.cov[..., 0] / S[component, rows][..., None]  # (h, axis, 3)
    gain[component == OUTLIER] = 0.0
    updated = Bank(
        mean=bank.mean + gain * innovation[..., None],
        cov=bank.cov - gain[..., :, None] * bank.cov[..., 0, None, :],
        surface=bank.surface,
        score=bank.score + evidence[component, rows],
        age=bank.age + (component != OUTLIER),
        tips=bank.tips.copy(),
    )
    for row in component.nonzero()[0]:
        kind = EventKind.WIDE if component[row] == WIDE else EventKind.OUTLIER
        updated.add_event(int(row), Event(kind, sample, time))
    return updated, whitened[GOOD].sum(-1)


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
