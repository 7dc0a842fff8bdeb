"""Sets patterns of force, kick and position error, which no effect describes, beside the effects of a model.

Under wrong physics the nearest effect explains a part, on both halves of the tracks. It is believed only if it explains
more than smooth patterns of place, velocity, spin and time would, whose sizes are as free as its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.diagnosis.evidence.rows import Motion, Rows, batches_of, roots, rows_of
from ballfg.diagnosis.fit.patterns import blocks_of
from ballfg.diagnosis.fit.problem import Fit

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
