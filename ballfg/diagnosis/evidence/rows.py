"""Rows of a fit, with columns for the motion that its model cannot explain, and for patterns that no effect describes.

Random columns are white acceleration in short bins of flight, kicks after contacts, and coefficients that scatter from
track to track; their sizes are the noise of the model. An effect is believed only if it explains more than smooth
patterns of place, velocity, spin and time would, whose sizes are as free as its own.
"""

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index, Mask
from ballfg.diagnosis.fit.free import OWN_AIR
from ballfg.diagnosis.fit.patterns import blocks_of
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.response import free_motion
from ballfg.diagnosis.fit.scatter import by_own
from ballfg.diagnosis.fit.stretches import batches_of, of_similar_length
from ballfg.state import SPIN, STATE_DIM

ACCELERATIONS, VELOCITIES, SPINS, COEFFICIENTS = range(4)
"""Kinds of random columns, from `COEFFICIENTS` on one for each coefficient; each has one size for all tracks."""
SPIN_KINDS: Final = 4
"""Kinds of spin rows: of labels, and of other spins about forward, across and up. Each has one size too."""


@dataclass(frozen=True)
class Motion:
    """Random columns of n stretches, batch by batch as in `batches_of`, and the coefficients that scatter beside them.

    The columns of the latter are those of each fit, at what its stretches have of their own.
    """

    columns: tuple[Array, ...]  # (b, m, r) derivatives at the unit of each kind, zero where a stretch has fewer
    kinds: tuple[Index, ...]  # (b, r) kind of each column, -1 for none
    spread: Mapping[str, float]  # Unit of each coefficient that scatters

    @property
    def units(self) -> Array:
        """(c,) of the coefficients that scatter."""
        return np.array(list(self.spread.values()))

    @property
    def own_kinds(self) -> Index:
        """(c,) kinds of the coefficients that scatter: those of a wind are one, for no axis comes first."""
        count = sum(name not in OWN_AIR for name in self.spread)
        return COEFFICIENTS + np.minimum(np.arange(len(self.spread)), count)

    def scatter(self, sizes: Sequence[float]) -> dict[str, float]:
        """What each coefficient differs by from track to track; sizes: logarithms, by kind."""
        return dict(zip(self.spread, (np.exp(np.array(sizes)[self.own_kinds]) * self.units).tolist(), strict=True))


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
        """(1 + SPIN_KINDS + k,) numbers that each size scales: coordinates of samples and spins, columns of k kinds."""
        random = np.bincount(self.kinds[self.kinds >= 0], minlength=COEFFICIENTS)
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
    stretches, root = fit.problem.stretches, roots(fit)
    by_coefficient = by_own(fit, list(motion.spread)) * motion.units / root
    used, system = stretches.used.numpy(), fit.linearised
    residual, by_start, by_common = system.residual / root[..., 0], system.by_start / root, system.by_common / root
    own = np.zeros((len(used), len(motion.spread)))
    for place, name in enumerate(motion.spread):
        own[:, place] = fit.unknowns.own.get(name, 0.0)
    own /= motion.units
    residual = residual + (by_coefficient @ own[..., None])[..., 0]
    return [
        Rows(
            batch.numbers,
            batch.of(residual),
            batch.of(by_start),
            batch.of(by_common),
            np.concatenate((batch.of(by_coefficient), random), axis=-1),
            np.concatenate((np.broadcast_to(motion.own_kinds, (len(kinds), len(motion.own_kinds))), kinds), axis=1),
            used[batch.numbers, : len(batch.rows) // 3 - 1],
            stretches.labelled[batch.numbers],
        )
        for batch, random, kinds in zip(batches_of(used), motion.columns, motion.kinds, strict=True)
    ]


def roots(fit: Fit) -> Array:
    """(n, m, 1) roots of the robust weights that a fit's rows have."""
    samples, spins = np.repeat(fit.robust.samples, 3, axis=1), np.repeat(fit.robust.spins[:, None], 3, axis=1)
    return np.sqrt(np.concatenate((samples, spins), axis=1))[..., None]


def scattering(fit: Fit) -> list[str]:
    """Coefficients that may differ from track to track: those that are the same for all, and a wind."""
    same = [n for n in fit.problem.free if n not in fit.problem.deviations and n not in OWN_AIR]
    return [*same, *OWN_AIR]


def random_motion(fit: Fit, of: Collection[str] | None = None) -> Motion:
    """The random columns of a fit.  Args: of: coefficients that may differ from track to track; None: `scattering`."""
    names = scattering(fit) if of is None else of
    own: dict[int, list[tuple[Array, Array]]] = defaultdict(list)
    for arc in fit.arcs:
        for row, piece in zip(arc.rows.tolist(), free_motion(fit, arc), strict=True):
            kinds = np.full(piece.columns.shape[1], ACCELERATIONS)
            if piece.contact is not None:
                kinds[-6:-3], kinds[-3:] = VELOCITIES, SPINS
            own[row].append((piece.columns * piece.sigma, kinds))
    air = fit.problem.in_own_air.declared_coefficients()
    units = {**fit.problem.free, **{name: air[name] for name in OWN_AIR}}
    spread = {name: units[name].sigma for name in names}
    root = roots(fit)
    found = []
    for batch in batches_of(fit.problem.stretches.used.numpy()):
        width = max(sum(len(k) for _, k in own[row]) for row in batch.numbers.tolist())
        random = np.zeros((len(batch.numbers), len(batch.rows), width))
        kinds = np.full((len(batch.numbers), width), -1)
        for place, row in enumerate(batch.numbers.tolist()):
            columns = np.concatenate([c for c, _ in own[row]], axis=1) / root[row]
            random[place, :, : columns.shape[1]] = columns[batch.rows]
            kinds[place, : columns.shape[1]] = np.concatenate([k for _, k in own[row]])
        found.append((random, kinds))
    columns, kinds = zip(*found, strict=True)
    return Motion(columns, kinds, spread)


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
