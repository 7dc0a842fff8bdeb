"""Finds the column that tells several balls of a recording apart."""

from ballfg.importing.formats.raw import RawTable, is_number
from ballfg.importing.names import IDENTITIES, words_of


def identified(
    table: RawTable, trajectory: str | None, time: tuple[str, ...], used: set[str]
) -> tuple[str | None, tuple[str, ...]]:
    """The column of trajectories, and a further one where one stamp of a trajectory has several positions.

    That one has the name of an identity, or text in it.
    """
    stamps = [table.columns[name].tolist() for name in time]
    known = [table.columns[trajectory].tolist()] if trajectory else []
    rows = len(table)
    if not time or rows == 0 or rows == len(set(zip(*known, *stamps, strict=True))):
        return trajectory, ()
    for name, column in table.columns.items():
        values = table.texts.get(name, column).tolist()
        said = bool(set(words_of(name)) & set(IDENTITIES)) or not is_number(column)
        if name in used or not said or len(set(values)) > rows // 2:
            continue
        if len(set(zip(*known, *stamps, values, strict=True))) == rows:
            return (name, ()) if trajectory is None else (trajectory, (name,))
    return trajectory, ()
