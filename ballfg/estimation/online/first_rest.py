"""Follows a ball that a stream first sees on a surface: it may roll, or slide with any spin.

Friction moves a sliding ball and leaves a rolling one alone; between the two the laws have a kink, so that a window is
right about one of them only. The Gaussians of both are followed until the samples tell them apart.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.compiled.kept_model import carried
from ballfg.dynamics.compiled.places import numbers_of
from ballfg.estimation.online.state import Sample
from ballfg.estimation.segmentation.settings import SegmentationSettings
from ballfg.estimation.sides.gaussians import GaussianMixture
from ballfg.estimation.sides.hypotheses import HypothesisModel
from ballfg.estimation.sides.monitor import NEGLIGIBLE
from ballfg.estimation.sides.struck import LEAST_CHANCE, beside, weighed
from ballfg.estimation.smoother.problem import START_POSITION_SIGMA, rolling_axes, rolling_spread
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY


@dataclass
class FirstRest:
    """Both hypotheses of a ball at rest on a surface since the first sample of a stream.

    Args: model: of the ball and its measurement.  priors: share and spread of outliers.

    Attributes:
        rolls: the hypothesis of the window, which it holds when its first samples leave it.
        balls: a sliding and a rolling Gaussian after `seen` samples; None where the ball was not at rest, or one of the
            hypotheses is certain.
    """

    model: HypothesisModel
    priors: SegmentationSettings
    rolls: bool = False
    balls: tuple[GaussianMixture, GaussianMixture] | None = None
    seen: int = 0
    certain: bool = False

    def reset(self) -> None:
        """Begins anew, without a ball at rest."""
        self.rolls, self.balls, self.certain = False, None, False

    def follow(self, samples: Sequence[Sample], begin: int) -> None:
        """Takes in the new ones of the samples of a window, the first of which has the number `begin` in the stream."""
        if self.certain:
            return
        if any(sample.motion.rest is None for sample in samples[not begin :]) or (begin and self.balls is None):
            self.balls = None
            return
        if self.balls is None:
            self.balls, self.seen = self._begun(samples), 1
        new = self.seen - begin
        for before, sample in zip(samples[new - 1 :], samples[new:], strict=False):
            self.balls = self._moved(self.balls, before, sample)
        self.seen = begin + len(samples)
        if not begin:
            self.rolls = self._doubt(self.balls, rolls=True) <= 0.5
        if self._doubt(self.balls, self.rolls) < NEGLIGIBLE:
            self.balls, self.certain = None, True

    def beside(self, mean: Array, joint: Array) -> tuple[Array, Array]:
        """Mean (d,) of the newest state and coefficients of the more probable hypothesis, and covariance of both.

        Args: mean, joint: (d,), (d, d), of the window.
        """
        if self.balls is None or (chance := self._doubt(self.balls, self.rolls)) < LEAST_CHANCE:
            return mean, joint
        other, d = self.balls[not self.rolls], len(mean)
        near, both = beside((mean, joint), (other.means[0, :d], other.covariances[0, :d, :d]), chance)
        return near[0], both

    @staticmethod
    def _doubt(balls: tuple[GaussianMixture, GaussianMixture], rolls: bool) -> float:
        """Probability that a hypothesis is wrong."""
        odds = balls[rolls].log_weight - balls[not rolls].log_weight
        return 1.0 / (1.0 + math.exp(min(odds, 100.0)))

    def _begun(self, samples: Sequence[Sample]) -> tuple[GaussianMixture, GaussianMixture]:
        """Both Gaussians at the first sample; the second shows about which velocity the laws are linear."""
        first, second = samples[:2]
        settings, width = self.model.settings, self.model.width
        d = width + self.model.biases
        mean, sigma = np.zeros(d), np.zeros(d)
        mean[POSITION], sigma[POSITION] = first.position, START_POSITION_SIGMA
        mean[VELOCITY] = (second.position - first.position) / (second.time - first.time)
        inner, names = carried(self.model.ball)
        mean[STATE_DIM:width] = [numbers_of(inner).value(name) for name in names]
        sigma[VELOCITY], sigma[STATE_DIM:width] = settings.velocity_prior, [*settings.coefficients.values()]
        if self.model.biases:
            sigma[width:] = settings.memory
        tied, found = np.eye(d), list[GaussianMixture]()
        tied[:STATE_DIM, :STATE_DIM] = np.linalg.inv(rolling_axes(self.model.ball.radius))
        for axes, spins in ((np.eye(d), np.full(3, settings.spin_prior)), (tied, rolling_spread(settings))):
            sigma[SPIN] = spins
            ball = GaussianMixture.single(axes @ mean, (axes * sigma**2) @ axes.T)
            found.append(weighed(self.model, ball, (first.position, first.stated), self.priors).merged())
        sliding, rolling = found
        return sliding, rolling

    def _moved(
        self, balls: tuple[GaussianMixture, GaussianMixture], before: Sample, sample: Sample
    ) -> tuple[GaussianMixture, GaussianMixture]:
        """Both Gaussians after a sample, with weights of the sum one."""
        assert sample.motion.rest is not None
        dt, measured = sample.time - before.time, (sample.position, sample.stated)
        both = self.model.predict_rest(GaussianMixture.concatenated(balls), dt, sample.motion.rest)
        sliding, rolling = (
            weighed(self.model, both.selected(np.arange(2) == k), measured, self.priors).merged() for k in range(2)
        )
        whole = float(np.logaddexp(sliding.log_weight, rolling.log_weight))
        return sliding.divided(whole), rolling.divided(whole)
