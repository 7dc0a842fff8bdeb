"""Evidence of many sets of further common unknowns beside the same ones, which are integrated out once."""

from dataclasses import dataclass

import numpy as np

from ballfg.arrays import Array, Index, Mask
from ballfg.diagnosis.evidence.likelihood import LOST, Posterior, Reduced, evidences, posterior, triangle


@dataclass(frozen=True)
class Condensed:
    """The likelihood of all tracks, of each half, and of each half with one track more of the other."""

    constant: Array  # (n,) what does not depend on the further unknowns, without the square of the residual
    gram: Array  # (n, k + 1, k + 1) inner products of their columns and the residual, last, over the noise
    halves: Mask  # (t,) which half each track belongs to

    @classmethod
    def of(cls, tracks: Reduced, precision: Array, away: Array, halves: Mask) -> "Condensed":
        """With the first unknowns integrated out.

        Args: tracks: the part of each.  precision: (c,) of the priors of the first unknowns.  away: (c,) prior mean
            less present value.  halves: (t,) which half each track belongs to.
        """
        own = len(precision)
        listed = [tracks.of(np.full(len(halves), True)), tracks.of(~halves), tracks.of(halves)]
        others = np.where(halves, 1, 2)
        sums = Reduced(*(np.concatenate([getattr(one, n) for one in listed]) for n in ("constant", "gram")))
        constant = np.append(sums.constant, sums.constant[others] + tracks.constant)
        gram = np.concatenate((sums.gram, sums.gram[others] + tracks.gram))
        further = gram[:, :own, own:].copy()
        further[..., -1] += precision * away
        lower = triangle(gram[:, :own, :own] + np.diag(precision))
        solved = np.linalg.solve(lower, further)
        left = gram[:, own:, own:] - solved.swapaxes(1, 2) @ solved
        left[:, -1, -1] += (precision * away**2).sum()
        narrow = np.log(np.diagonal(lower, axis1=1, axis2=2)).sum(axis=1) - 0.5 * np.log(precision).sum()
        return cls(constant - narrow, left, halves)

    def evidence(self, columns: Index, precision: Array) -> Array:
        """(n,) of each part, with some further unknowns, whose priors are about their present values; NaN: none.

        Args: columns: (k,) their numbers.  precision: (k,) of their priors.
        """
        return evidences(self._part(columns), precision, np.zeros(len(columns)))

    def whole(self, columns: Index, precision: Array) -> Posterior:
        """The posterior of some further unknowns from all tracks.  Args: as of `evidence`."""
        part = self._part(columns)
        return posterior(Reduced(part.constant[:1], part.gram[:1]), precision, np.zeros(len(columns)))

    def held_out(self, columns: Index, precision: Array) -> Array:
        """As `likelihood.held_out`, with some further unknowns.  Args: as of `evidence`."""
        evidence = self.evidence(columns, precision)
        found = evidence[3:] - evidence[np.where(self.halves, 1, 2)]
        return found if np.isfinite(found).all() else np.full(len(found), LOST)

    def _part(self, columns: Index) -> Reduced:
        listed = np.append(columns, self.gram.shape[-1] - 1)
        return Reduced(self.constant, self.gram[:, listed[:, None], listed])
