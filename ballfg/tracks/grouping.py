"""Groups rows to trajectories, one at a time, in any order of the rows.

If the rows of each trajectory are contiguous, the file is streamed: one block and one trajectory are in memory. If the
trajectories interleave, each pass first sorts the rows in a temporary file (8 bytes a value, 40 to 64 bytes a row, in
the system's temporary folder): a counting sort, because the scan has counted the rows of each trajectory. Either way,
memory grows with the longest trajectory, not with their number.
"""

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby, pairwise

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.checks import LARGEST, NAME_RULE, is_name, shown
from ballfg.tracks.csv_files import no_rows
from ballfg.tracks.rows import Block, RowSource

MIN_SIGMA, MAX_SIGMA = 1e-9, 1e6  # m, of a sample; a large one marks a sample with little weight


@dataclass(frozen=True)
class RowGroup:
    """All rows of one trajectory, in the order of the file."""

    name: str

    rows: NDArray[np.int64]  # (n,) number of each row in the file, from 0
    values: Array  # (n, 4) or (n, 7), as in Block


@dataclass(frozen=True)
class Index:
    """The result of one scan of the file."""

    names: list[str]  # the trajectories in the order in which they first appear
    counts: NDArray[np.int64]  # (number of trajectories,) rows of each
    contiguous: bool  # True if the rows of each trajectory are contiguous
    stamp: tuple[int, int]  # size (bytes) and modification time (ns) of the scanned file


def scan(source: RowSource) -> Index:
    """Reads the file once, checks every cell, counts rows of trajectories. Raises: ValueError: no rows, a bad cell."""
    stamp = source.stamp()
    codes_of: dict[str, int] = {}
    counts: list[int] = []
    contiguous = True
    last = -1
    for block in source.blocks():
        check_cells(source, block)
        known = len(counts)
        codes = _global_codes(block, codes_of)
        counts.extend([0] * (len(codes_of) - known))
        # A run may only continue the last trajectory or begin the next new one.
        for start, end in _runs(codes):
            code = int(codes[start])
            contiguous &= code == last or counts[code] == 0
            counts[code] += end - start
            last = code
    if not counts:
        raise no_rows(source.path)
    return Index(list(codes_of), np.array(counts, dtype=np.int64), contiguous, stamp)


def groups(source: RowSource, index: Index) -> Iterator[RowGroup]:
    """The trajectories in the order of their first rows. Raises: ValueError: the file has changed since the scan."""
    if source.stamp() != index.stamp:
        raise ValueError(f"{source.path}: must not change while it is in use; it did. Call read_dataset again.")
    return _stream(source) if index.contiguous else _regroup(source, index)


def check_cells(source: RowSource, block: Block) -> None:
    """Refuses a block with a nameless row, a value that is not finite, or an invalid sigma."""
    for code, name in enumerate(block.names):
        if not name or not is_name(name):
            row = block.start + int(np.argmax(block.codes == code))
            problem = f"{source.where(row)}, column 'trajectory': must be {NAME_RULE}; got {shown(name or '')}"
            raise ValueError(f"{problem}. Fill in a name.")
    bad = ~(np.abs(block.values) <= LARGEST)
    sigmas = block.values[:, 4:]
    bad[:, 4:] |= (sigmas < MIN_SIGMA) | (sigmas > MAX_SIGMA)
    if bad.any():
        row, column = (int(i) for i in np.argwhere(bad)[0])
        value = float(block.values[row, column])
        rule = "finite" if not np.isfinite(value) else f"at most {LARGEST:g} in size"
        remedy = "Delete the line: a missing sample needs no row."
        if column >= 4:
            rule = f"a standard deviation of {MIN_SIGMA:g} to {MAX_SIGMA:g} m"
            remedy = "Correct it, or drop the sigma columns."
        place = f"{source.where(block.start + row)}, column {shown(source.columns[column])}"
        raise ValueError(f"{place}: must be {rule}; got {value:g}. {remedy}")


def _global_codes(block: Block, codes_of: dict[str, int]) -> NDArray[np.int32]:
    """(n,) the trajectory's number for each row; new trajectories get the next numbers."""
    numbers = [codes_of.setdefault(str(name), len(codes_of)) for name in block.names]
    return np.array(numbers, dtype=np.int32)[block.codes]


def _runs(codes: NDArray[np.int32]) -> list[tuple[int, int]]:
    edges = [0, *(np.flatnonzero(np.diff(codes)) + 1).tolist(), len(codes)]
    return list(pairwise(edges)) if len(codes) else []


def _stream(source: RowSource) -> Iterator[RowGroup]:
    pieces = (
        RowGroup(str(block.names[block.codes[start]]), np.arange(start, end) + block.start, block.values[start:end])
        for block in source.blocks()
        for start, end in _runs(block.codes)
    )
    for name, run in groupby(pieces, key=lambda piece: piece.name):
        rows, values = zip(*((piece.rows, piece.values) for piece in run), strict=True)
        yield RowGroup(name, np.concatenate(rows), np.concatenate(values))


def _regroup(source: RowSource, index: Index) -> Iterator[RowGroup]:
    width = 1 + len(source.columns)
    codes_of = {name: code for code, name in enumerate(index.names)}
    position = (np.cumsum(index.counts) - index.counts).tolist()
    with tempfile.TemporaryFile(prefix="ballfg-") as file:
        for block in source.blocks():  # each row, its number and values, goes to its trajectory's place
            codes = _global_codes(block, codes_of)
            order = np.argsort(codes, kind="stable")
            table = np.column_stack([(block.start + order).astype(np.float64), block.values[order]])
            for start, end in _runs(codes[order]):
                code = int(codes[order[start]])
                file.seek(position[code] * width * 8)
                file.write(table[start:end].tobytes())
                position[code] += end - start
        file.seek(0)
        for name, count in zip(index.names, index.counts, strict=True):
            table = np.frombuffer(file.read(int(count) * width * 8), dtype=np.float64).reshape(-1, width)
            # A row number is exact in float64 up to 2**53.
            yield RowGroup(name, table[:, 0].astype(np.int64), table[:, 1:])
