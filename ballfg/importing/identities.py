"""Finds the column that tells several balls of a recording apart."""

from itertools import product

from ballfg.importing.formats.raw import RawTable, is_number
from ballfg.importing.names import IDENTITIES, words_of


def identified(
    table: RawTable, trajectory: str | None, time: tuple[str, ...], used: set[str]
) -> tuple[str | None, tuple[str, ...]]:
    """The column of trajectories, and a further one where one stamp of a trajectory has several positions.

    That one has the name of an identity, or text in it, or its whole numbers count the shots of each.
    """
    stamps = [table.columns[name].tolist() for name in time]
    known = [table.columns[trajectory].tolist()] if trajectory else []
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
