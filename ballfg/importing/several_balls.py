"""Tells the balls of a recording apart: side by side, as `left_x, left_y, left_z, right_x, ...`, or by a column."""

from collections.abc import Mapping
from itertools import combinations, product
from typing import Final

import numpy as np

from ballfg.importing.choices import Choices
from ballfg.importing.formats.raw import RawTable, is_number, numbers
from ballfg.importing.names import IDENTITIES, meanings, words_of

APART: Final = 0.02
"""Least median distance of two balls over the extent of their paths; nearer places are one ball's, measured twice."""
MEASURED_TWICE: Final = frozenset((
    "raw", "filtered", "smooth", "smoothed", "kalman", "est", "estimated", "pred", "predicted", "view", "reprojected",
))  # fmt: skip


def balls_of(table: RawTable, choices: Choices) -> list[RawTable]:
    """A table for each ball with columns of its own, named by it; the table itself if it holds one ball.

    Columns that belong to no ball, such as the time, go to all of them.
    """
    if not table.named or {"x", "y", "z"} & set(choices.columns):
        return [table]
    groups: dict[str, dict[str, str]] = {}  # words beside the axis -> axis -> column
    ranks: dict[str, int] = {}
    titles: dict[str, str] = {}  # of the columns in the table of one ball
    clocks = False
    for name, column in table.columns.items():
        for one in meanings(name):
            clocks |= one.role in ("t", "seconds", "frame")
            plain = one.role in "xyz" and is_number(column) and not set("xyz") & set(one.group.split("."))
            if plain and one.role not in groups.setdefault(one.group, {}):
                groups[one.group][one.role] = name
                ranks[one.group] = ranks.get(one.group, 0) + one.rank
                titles[name] = one.role if one.unit is None else f"{one.role} [{one.unit}]"
    axes = max((set(group) for group in groups.values()), key=len, default=set[str]())
    whole = {words: group for words, group in groups.items() if set(group) == axes}
    best = {words: whole[words] for words in whole if ranks[words] == min(ranks[one] for one in whole)}
    if not clocks or len(best) < 2 or "z" not in axes or not _apart(table, best):
        return [table]
    taken = {name for group in groups.values() for name in group.values()}
    shared = {name: column for name, column in table.columns.items() if name not in taken}
    found = []
    for words, group in best.items():
        own = {titles[name]: table.columns[name] for name in group.values()}
        texts = {
            titles.get(name, name): text for name, text in table.texts.items() if name in {*shared, *group.values()}
        }
        name = f"{table.name}/{words.replace('.', '-')}" if table.name else words.replace(".", "-")
        found.append(RawTable(name, shared | own, table.source, notes=table.notes, texts=texts))
    return found


def _apart(table: RawTable, groups: Mapping[str, Mapping[str, str]]) -> bool:
    """True if the columns are those of different balls, by their words and their places."""
    if any(len(set(table.columns[group["z"]].tolist())) < 2 for group in groups.values()):
        return False
    if any(MEASURED_TWICE & set(words.split(".")) for words in groups):
        return False
    paths = [np.stack([numbers(table.columns[group[a]]) for a in sorted(group)], axis=1) for group in groups.values()]
    for one, other in combinations(paths, 2):
        both = np.isfinite(one).all(axis=1) & np.isfinite(other).all(axis=1)
        if both.sum() > 1:
            extent = float(np.linalg.norm(np.ptp(one[both], axis=0)))
            if np.median(np.linalg.norm(one - other, axis=1)[both]) < APART * extent:
                return False
    return True


def identified(
    table: RawTable, trajectory: str | None, time: tuple[str, ...], used: set[str]
) -> tuple[str | None, tuple[str, ...]]:
    """The column of trajectories, and a further one where one stamp of a trajectory has several positions.

    That one has the name of an identity, or text in it, or its whole numbers count the shots of each.
    """
    stamps = [table.columns[name].tolist() for name in time]
    known = [table.texts.get(trajectory, table.columns[trajectory]).tolist()] if trajectory else []
    rows = len(table)
    if not time or rows == 0 or rows == len(set(zip(*known, *stamps, strict=True))):
        return trajectory, ()
    cells = {name: table.texts.get(name, column).tolist() for name, column in table.columns.items() if name not in used}
    few = {name: values for name, values in cells.items() if len(set(values)) <= rows // 2}
    said = [n for n in few if set(words_of(n)) & set(IDENTITIES) or not is_number(table.columns[n])]
    for name in said:
        if len(set(zip(*known, *stamps, few[name], strict=True))) == rows:
            return (name, ()) if trajectory is None else (trajectory, (name,))
    counts = [name for name in few if table.columns[name].dtype.kind == "i" and name not in said]
    names = {name: few[name] for name in said} if trajectory is None else {trajectory: known[0]}
    for name, count in product(names, counts):
        if len(set(zip(names[name], *stamps, few[count], strict=True))) == rows:
            return name, (count,)
    return trajectory, ()
