"""Rows of a fit, with columns for the motion that its model cannot explain, and for patterns that no effect describes.

Random columns are white acceleration in short bins of flight, kicks after contacts, and coefficients that scatter from
track to track; their sizes are the noise of the model. An effect is believed only if it explains more than smooth
patterns of place, velocity, spin and time would, whose sizes are as free as its own.
"""

from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index, Mask
from ballfg.diagnosis.fit.patterns import blocks_of
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.response import ACCELERATION, CONTACT_SPIN, CONTACT_VELOCITY, free_motion
from ballfg.diagnosis.fit.stretches import batches_of, of_similar_length
from ballfg.state import SPIN, STATE_DIM

ACCELERATIONS, VELOCITIES, SPINS, COEFFICIENTS = range(4)
"""Kinds of random columns; each kind has one size for all tracks."""
KINDS: Final = 4
SPIN_KINDS: Final = 4
"""Kinds of spin rows: of labels, and of other spins about forward, across and up. Each has one size too."""
SIZES: Final = (ACCELERATION, CONTACT_VELOCITY, CONTACT_SPIN, 1.0)
"""Unit of each size: m/s^2/sqrt(Hz), m/s, rad/s, and prior standard deviations of the coefficients."""


@dataclass(frozen=True)
class Motion:
    """Random columns of n stretches, batch by batch as in `batches_of`."""

    columns: tuple[Array, ...]  # (b, m, r) derivatives at the unit of each kind, zero where a stretch has fewer
    kinds: tuple[Index, ...]  # (b, r) kind of each column, -1 for none


@dataclass(frozen=True)
class Rows:
    """Whitened rows of b stretches without robust weights: three for each of k samples, then three for the spin."""

    numbers: Index  # (b,) of the stretches among all
    residual: Array  # (b, m) measured minus predicted
    by_start: Array  # (b, m, 9) derivatives by the first state
    by_common: Array  # (b, m, q) by the unknowns that all stretches share
    random: Array  # (b, m, r) the random columns
    kinds: Index  # (b, r) kind of each, -1 for none
    used: Mask  # (b, k) samples that there are
    labelled: Mask  # (b,) True where the spin rows compare with a label

    @property
    def counts(self) -> Array:
        """(1 + SPIN_KINDS + KINDS,) numbers that each size scales: coordinates of samples and spins, random columns."""
        random = [(self.kinds == kind).sum() for kind in range(KINDS)]
        spins = np.bincount(self.spin_kinds.ravel(), minlength=SPIN_KINDS)
        return np.array([3 * self.used.sum(), *spins, *random], dtype=np.float64)

    @property
    def spin_kinds(self) -> Index:
        """(b, 3) kind of each spin row: 0 of a label, which has no axes of its own, else 1, 2, 3 by the launch's."""
        return np.where(self.labelled[:, None], 0, np.arange(1, SPIN_KINDS))

    @cached_property
    def volume(self) -> Array:
        """(b,) half the log determinant of the information on what has no prior of its own, at the stated noise.

        It is the density of their prior, uniform in what samples and labels show of them (H. Jeffreys, "An invariant
        form for the prior probability in estimation problems", Proc. R. Soc. A 186, 1946): uniform in metres per
        second, a slower clock would be more probable than less gravity. Spins without labels have a prior.
        """
        information, diagonal = self.by_start.swapaxes(1, 2) @ self.by_start, np.arange(STATE_DIM)
        information[~self.labelled, SPIN], information[~self.labelled, :, SPIN] = 0.0, 0.0
        information[:, diagonal, diagonal] += information[:, diagonal, diagonal] == 0.0
        return np.asarray(0.5 * np.linalg.slogdet(information)[1])

    @cached_property
    def gram(self) -> Array:
        """(b, d, d) inner products of the rows of samples; columns start, random, common, residual."""
        listed = (self.by_start, self.random, self.by_common, self.residual[..., None])
        rows = np.concatenate([columns[:, :-3] for columns in listed], axis=-1)  # zero for samples that are not there
        return rows.swapaxes(1, 2) @ rows

    def inner_products(self, weights: Array) -> Array:
        """(b, d, d) the same of weighted samples; weights: (b, k), not negative. It is fast where few are not zero."""
        listed = (self.by_start, self.random, self.by_common, self.residual[..., None])
        size, used = sum(columns.shape[-1] for columns in listed), (weights != 0.0) & self.used
        first = np.argsort(~used, axis=1, kind="stable")
        found = np.zeros((len(used), size, size))
        for stretches, count in of_similar_length(used):
            samples = first[stretches, :count]
            root = np.sqrt(weights[stretches[:, None], samples] * used[stretches[:, None], samples])
            places = (3 * samples[..., None] + np.arange(3)).reshape(len(stretches), -1)
            alike = [columns[stretches[:, None], places] for columns in listed]
            rows = np.concatenate(alike, axis=-1) * np.repeat(root, 3, axis=1)[..., None]
            found[stretches] = rows.swapaxes(1, 2) @ rows
        return found

    def beside(self, columns: Array) -> "Rows":
        """The rows with further common unknowns, last; columns: (b, m, p)."""
        return replace(self, by_common=np.concatenate((self.by_common, columns), axis=-1))


def rows_of(fit: Fit, motion: Motion) -> list[Rows]:
    """The rows of a fit at its minimum; motion: `random_motion` of this or a similar fit to the same samples."""
    system, stretches, root = fit.linearised, fit.problem.stretches, roots(fit)
    used = stretches.used.numpy()
    residual, by_start, by_common = system.residual / root[..., 0], system.by_start / root, system.by_common / root
    return [
        Rows(
            batch.numbers,
            batch.of(residual),
            batch.of(by_start),
            batch.of(by_common),
            random,
            kinds,
            used[batch.numbers, : len(batch.rows) // 3 - 1],
            stretches.labelled[batch.numbers],
        )
        for batch, random, kinds in zip(batches_of(used), motion.columns, motion.kinds, strict=True)
    ]


def roots(fit: Fit) -> Array:
    """(n, m, 1) roots of the robust weights that a fit's rows have."""
    samples, spins = np.repeat(fit.robust.samples, 3, axis=1), np.repeat(fit.robust.spins[:, None], 3, axis=1)
    return np.sqrt(np.concatenate((samples, spins), axis=1))[..., None]


def random_motion(fit: Fit, scattering: Collection[str] | None = None) -> Motion:
    """The random columns of a fit.

    Args: scattering: coefficients that may differ from track to track; None: all that are the same for all tracks.
    """
    if scattering is None:
        scattering = [name for name in fit.problem.free if name not in fit.problem.deviations]
    own: dict[int, list[tuple[Array, Array]]] = defaultdict(list)
    for arc in fit.arcs:
        for row, piece in zip(arc.rows.tolist(), free_motion(fit, arc), strict=True):
            kinds = np.full(piece.columns.shape[1], ACCELERATIONS)
            if piece.contact is not None:
                kinds[-6:-3], kinds[-3:] = VELOCITIES, SPINS
            own[row].append((piece.columns * piece.sigma, kinds))
    listed = list(fit.problem.free)
    chosen = [listed.index(name) for name in scattering]
    spread, count = np.array([fit.problem.free[name].sigma for name in scattering]), len(chosen)
    root = roots(fit)
    coefficients = fit.linearised.by_common[..., chosen] * spread / root
    found = []
    for batch in batches_of(fit.problem.stretches.used.numpy()):
        width = count + max(sum(len(k) for _, k in own[row]) for row in batch.numbers.tolist())
        random = np.zeros((len(batch.numbers), len(batch.rows), width))
        kinds = np.full((len(batch.numbers), width), -1)
        random[..., :count], kinds[:, :count] = batch.of(coefficients), COEFFICIENTS
        for place, row in enumerate(batch.numbers.tolist()):
            columns = np.concatenate([c for c, _ in own[row]], axis=1) / root[row]
            random[place, :, count : count + columns.shape[1]] = columns[batch.rows]
            kinds[place, count : count + columns.shape[1]] = np.concatenate([k for _, k in own[row]])
        found.append((random, kinds))
    return Motion(*zip(*found, strict=True))


NAMELESS: Final = "something nameless"
USUAL: Final = 0.125
"""Usual strength of a pattern, in the unit of its column, which is large: widths of its prior reach twice that."""


@dataclass(frozen=True)
class Patterns:
    """Columns of all patterns at a fit.

    Attributes:
        columns: (b, m, p) whitened responses of the samples to patterns that are large in practice, batch by batch.
        blocks: where in p the columns of each block are; those of a block share the width of their prior.
    """

    columns: tuple[Array, ...]
    blocks: tuple[Index, ...]

    @classmethod
    def of(cls, fit: Fit) -> "Patterns":
        """The patterns that a fit's flights, contacts and positions may have."""
        blocks = blocks_of(fit)
        ends = np.cumsum([block.columns.shape[-1] for block in blocks])
        places = tuple(np.arange(end - b.columns.shape[-1], end) for b, end in zip(blocks, ends, strict=True))
        columns = np.concatenate([block.columns for block in blocks], axis=-1) / roots(fit)
        return cls(tuple(batch.of(columns) for batch in batches_of(fit.problem.stretches.used.numpy())), places)

    def beside(self, rows: Sequence[Rows]) -> list[Rows]:
        """Rows with the patterns as further common unknowns, last."""
        return [batch.beside(columns) for batch, columns in zip(rows, self.columns, strict=True)]


def rows_beside(fit: Fit, motion: Motion, patterns: Patterns | None) -> list[Rows]:
    """The rows of a fit as of `rows_of`, with patterns as further common unknowns if there are some."""
    rows = rows_of(fit, motion)
    return rows if patterns is None else patterns.beside(rows)
