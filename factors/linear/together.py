"""The linear subproblems of many tracks at once, in torch: QR state by state, as in `elimination`, of all of them.

One call of torch reduces one state of every track. That is slow for a few tracks and quick for thousands on a device
that computes them side by side.
"""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ballfg.arrays import Array, Index
from ballfg.factors.graph import LinearSolution
from ballfg.factors.linear.step import Root, Step, damped_rows


def solve_together(problems: Sequence[LinearSolution], device: torch.device) -> list[Step | None]:
    """The steps that `solve` finds for each of several tracks, up to rounding.

    Args: problems: of any lengths and unknowns; those with the same unknowns at a time are solved together.
    """
    alike: defaultdict[tuple[int, int], list[int]] = defaultdict(list)
    for number, one in enumerate(problems):
        alike[one.values.width, len(one.values.coefficients)].append(number)
    found: dict[int, Step | None] = {}
    for (width, p), numbers in alike.items():
        found.update(zip(numbers, _solved([problems[i] for i in numbers], width, p, device), strict=True))
    return [found[number] for number in range(len(problems))]


def _solved(problems: Sequence[LinearSolution], width: int, p: int, device: torch.device) -> list[Step | None]:
    """The steps of t tracks with w numbers at each time and p coefficients."""
    made = [damped_rows(one.linearized, one.values, one.damping) for one in problems]
    lengths = np.array([len(one.values.states) for one in problems])
    rows, starts = _gathered([(system, start) for system, start, _ in made], lengths, width, p)
    triangles, shared = _eliminated(torch.from_numpy(rows).to(device), starts, lengths, width, p)
    solved = _substituted(triangles, shared, lengths, width, p)
    roots, last, steps, coefficients = (tensor.cpu().numpy() for tensor in (triangles, shared, *solved))
    return [
        Step.of(Root(roots[k, :n], last[k]), steps[k, :n].copy(), coefficients[k, :, 0].copy(), one.damping, made[k][2])
        for k, (one, n) in enumerate(zip(problems, lengths, strict=True))
    ]


def _gathered(systems: Sequence[tuple[Array, Index]], lengths: Index, width: int, p: int) -> tuple[Array, Index]:
    """The rows of all tracks one behind another, and a row of zeros at their end.

    Returns: rows (r + 1, 2 w + p + 1). For each track, where the rows of each state begin (t, n + 2): those of its
        coefficients alone are the last; a state beyond its end has none.
    """
    starts, offset = np.empty((len(systems), lengths.max() + 2), dtype=np.int64), 0
    for own, (system, start), n in zip(starts, systems, lengths, strict=True):
        own[: n + 1], own[n + 1 :] = start[: n + 1] + offset, start[n] + offset
        own[-1] = start[n + 1] + offset
        offset += len(system)
    rows = np.zeros((offset + 1, 2 * width + p + 1))
    np.concatenate([system[:, : 2 * width + p] for system, _ in systems], out=rows[:-1, :-1])
    np.concatenate([system[:, -1] for system, _ in systems], out=rows[:-1, -1])
    return rows, starts


def _eliminated(rows: Tensor, starts: Index, lengths: Index, width: int, p: int) -> tuple[Tensor, Tensor]:
    """The triangles of all tracks.

    A state beyond a track's end is held at zero, so that what the states before left for the coefficients passes it.

    Args: rows, starts: as `_gathered` returns them.  lengths: (t,) number of states.
    Returns: (t, n, w, 2 w + p + 1) and (t, p, 2 w + p + 1) as in `Root`.
    """
    t, n, columns = len(lengths), int(lengths.max()), rows.shape[1]
    carry, triangles = rows.new_zeros((t, width + p, columns)), rows.new_empty((t, n, width, columns))
    held = rows.new_zeros((width, columns))
    held[:, :width].diagonal().fill_(1.0)
    for k in range(n):
        parts = [carry, _of_state(rows, starts, k)]
        ended = torch.from_numpy(lengths <= k).to(rows.device)
        if (lengths <= k).any():
            parts.insert(0, ended[:, None, None] * held)
        reduced = _triangle(torch.cat(parts, dim=1))
        triangles[:, k] = reduced[:, :width]
        carry = torch.zeros_like(carry)
        carry[:, :, :width] = reduced[:, width : 2 * width + p, width : 2 * width]
        carry[:, :, 2 * width :] = reduced[:, width : 2 * width + p, 2 * width :]
    shared = rows.new_zeros((t, p, columns))
    if p:
        alone = torch.cat((carry, _of_state(rows, starts, n)), dim=1)[..., 2 * width :]
        shared[..., 2 * width :] = _triangle(alone)[:, :p]
    return triangles, shared


def _of_state(rows: Tensor, starts: Index, k: int) -> Tensor:
    """(t, m, 2 w + p + 1) the rows of one state of every track, filled up with zeros."""
    begin, end = starts[:, k, None], starts[:, k + 1, None]
    places = begin + np.arange(int((end - begin).max()))
    return rows[torch.from_numpy(np.where(places < end, places, len(rows) - 1)).to(rows.device)]


def _triangle(rows: Tensor) -> Tensor:
    """(t, c, c) R of a QR of (t, m, c); rows of zeros where m is less than c."""
    missing = rows.shape[2] - rows.shape[1]
    full = rows if missing <= 0 else torch.cat((rows, rows.new_zeros((len(rows), missing, rows.shape[2]))), dim=1)
    return torch.linalg.qr(full, mode="r").R


def _substituted(triangles: Tensor, shared: Tensor, lengths: Index, width: int, p: int) -> tuple[Tensor, Tensor]:
    """Steps (t, n, w) of states and (t, p, 1) of coefficients; not finite where a system is singular."""
    steps = torch.zeros_like(triangles[..., 0])
    coefficients = _solve_triangle(shared[..., 2 * width : 2 * width + p], shared[..., -1:])
    later = steps.new_zeros((len(steps), width, 1))
    for k in range(triangles.shape[1] - 1, -1, -1):
        own, coupling, by_shared = triangles[:, k].split((width, width, p + 1), dim=-1)
        right = by_shared[..., p:] - coupling @ later - by_shared[..., :p] @ coefficients
        there = torch.from_numpy(lengths > k).to(own.device)[:, None, None]
        later = torch.where(there, _solve_triangle(own, right), 0.0)
        steps[:, k] = later[..., 0]
    return steps, coefficients


def _solve_triangle(upper: Tensor, right: Tensor) -> Tensor:
    return torch.linalg.solve_triangular(upper, right, upper=True)
