"""Maximises the marginal likelihood of linearised tracks: the density of each sample given those before it."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.noise.linear_filter import LinearFilter, Noise
from ballfg.estimation.noise.parameters import Parameter, by_logs, noise_of
from ballfg.estimation.settings import Settings

DIFFERENCE: Final = 0.002
"""Step of a logarithm for the second derivatives behind the error bars."""


def scatter_of(gradients: Array) -> Array:
    """(k, k) squares of the gradients (t, k) of tracks about their mean, summed over t tracks."""
    count, away = len(gradients), gradients - gradients.mean(axis=0)
    return np.asarray(away.T @ away * count / max(count - 1, 1))


class MarginalFit:
    """The noise that maximises the density of the next samples of tracks.

    Args:
        tracks: the filter of the tracks.
        settings: values of all other numbers.
        parameters: the numbers to estimate.
        begin: logarithms of numbers, by name and axis, as a start; others start at their prior medians.
        tolerance: largest derivative at the minimum, by numbers in their standard deviations.
        most: largest number of evaluations; a flat likelihood does not converge.

    Attributes:
        logs: (k,) logarithms of the numbers.
        losses: (t,) negative logarithm of the density of each track at `logs`.
    """

    def __init__(
        self,
        tracks: LinearFilter,
        settings: Settings,
        parameters: list[Parameter],
        begin: Mapping[tuple[str, int | None], float] = MappingProxyType({}),
        *,
        tolerance: float = 0.2,
        most: int = 40,
    ) -> None:
        self.tracks, self.settings, self.parameters = tracks, settings, parameters
        self.start = np.log([p.start for p in parameters])
        self.precision = np.array([p.spread**-2 for p in parameters])
        first = [begin.get((p.name, p.axis), log) for p, log in zip(parameters, self.start.tolist(), strict=True)]
        self.logs = np.array(first)
        self.losses, self.gradients = self.at(self.logs)
        self._minimise(tolerance, most)

    @property
    def known(self) -> dict[tuple[str, int | None], float]:
        """The logarithms by name and axis."""
        return {(p.name, p.axis): log for p, log in zip(self.parameters, self.logs.tolist(), strict=True)}

    def values(self, name: str) -> Array:
        """The values of a number along all its axes; (0,) if it is not estimated."""
        return np.exp([log for p, log in zip(self.parameters, self.logs, strict=True) if p.name == name])

    def at(self, logs: Array) -> tuple[Array, Array]:
        """(t,) losses of the tracks at some logarithms, and (t, k) their derivatives."""
        noise = noise_of(self.parameters, logs[None], self.settings)
        losses, slopes = self.tracks.losses(noise)
        return losses, by_logs(self.parameters, noise, slopes)

    def noise(self) -> Noise:
        """The estimated noise, one row for all tracks."""
        return noise_of(self.parameters, self.logs[None], self.settings)

    def covariance(self) -> Array:
        """(k, k) of the logarithms, from the scatter of the tracks' gradients (the sandwich of P. J. Huber, 1967)."""
        size, total = len(self.logs), self.gradients.sum(axis=0)
        hessian = np.empty((size, size))
        for k in range(size):
            step = np.zeros(size)
            step[k] = DIFFERENCE
            hessian[k] = (self.at(self.logs + step)[1].sum(axis=0) - total) / DIFFERENCE
        values, vectors = np.linalg.eigh(0.5 * (hessian + hessian.T) + np.diag(self.precision))
        inverse = (vectors / np.maximum(values, self.precision.min())) @ vectors.T
        return np.asarray(inverse @ (scatter_of(self.gradients) + np.diag(self.precision)) @ inverse)

    def _objective(self, losses: Array, gradients: Array, logs: Array) -> tuple[float, Array]:
        """Negative log posterior and its (k,) derivatives."""
        away = logs - self.start
        value = float(losses.sum()) + 0.5 * float(self.precision @ away**2)
        return value, gradients.sum(axis=0) + self.precision * away

    def _minimise(self, tolerance: float, most: int) -> None:
        """Moves to the minimum of the negative log posterior.

        The search variables are scaled to a unit scatter of the tracks' gradients, which approximates the second
        derivatives (Berndt, Hall, Hall and Hausman 1974). A first step may still lead to noise so large that rounding
        leaves no density; it counts as worse than the start, so that the line search shortens the step.
        """
        root = np.linalg.cholesky(scatter_of(self.gradients) + np.diag(self.precision))
        turn = np.linalg.inv(root).T
        begin, worst = self.logs, self._objective(self.losses, self.gradients, self.logs)[0]

        def objective(way: Array) -> tuple[float, Array]:
            logs = begin + turn @ way
            try:
                value, gradient = self._objective(*self.at(logs), logs)
            except np.linalg.LinAlgError:
                return worst + float(way @ way), 2.0 * way
            return value, turn.T @ gradient

        options = {"gtol": tolerance, "ftol": 0.0, "maxfun": most, "maxcor": len(begin)}
        from scipy.optimize import minimize  # it takes half a second to import

        found = minimize(objective, np.zeros(len(begin)), jac=True, method="L-BFGS-B", options=options)
        self.logs = begin + turn @ found.x
        self.losses, self.gradients = self.at(self.logs)
