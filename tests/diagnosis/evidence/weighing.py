"""Weighs fits of tests as the search does."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ballfg.diagnosis.evidence.rows import Motion, random_motion
from ballfg.diagnosis.evidence.weighed import Weighed, weighed
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis


def weigh(fit: Fit, named: Sequence[Hypothesis] = ()) -> tuple[Weighed, Motion]:
    """A fit with its evidence, and its random columns; every second track is of the search half."""
    motion = random_motion(fit, [name for name in fit.problem.free if name not in fit.problem.deviations])
    halves = np.arange(len(np.unique(fit.problem.stretches.track))) % 2 == 0
    return weighed(fit, named, motion, halves), motion
