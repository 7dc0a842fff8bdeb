"""Moving new files into a folder that exists, so that a kill leaves the old or the new result, never a mixture.

A plan is written first. From then on the new result counts: whoever finds the plan carries it out to its end. Every
step can be repeated, so it does not matter where the last attempt ended.
"""

import json
import os
import time
import uuid
from collections.abc import Collection, Iterable, Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final

from ballfg.files.held import MARK, NEW, OLD, PLAN, BeingWrittenError, clear, held
from ballfg.files.json_file import read_json
from ballfg.files.whole_file import flush, flush_folder

PATIENCE: Final = 10.0
"""s that a reader waits for a writer that is moving its files; this takes milliseconds."""


def move_in(place: Path, folder: Path, earlier: Iterable[str], last: str | None, merged: Collection[str]) -> None:
    """Moves what lies in the hidden folder `place` to its names in `folder`; arguments as for `whole_folder`."""
    _write_plan(place, folder, tuple(earlier), last, merged)
    try:
        carry_out(place, folder)
    except BaseException:  # after Ctrl-C, or a call that failed once, the result is made whole at once
        carry_out(place, folder)
        raise


def carry_out(place: Path, folder: Path) -> None:
    """Carries out a plan, from wherever an earlier attempt ended.

    Raises: ValueError: it is no plan, or one that would touch what lies outside of the folder.
    """
    if not (place / PLAN).exists():
        return
    stale, new = _read_plan(place / PLAN, folder)
    (place / OLD).mkdir(exist_ok=True)
    for name in stale:
        _put_aside(folder / name, place)
    for name in new:
        source, target = place / NEW / name, folder / name
        if os.path.lexists(source):  # else it has been moved already
            if target.is_dir() or (os.path.lexists(target) and source.is_dir()):
                _put_aside(target, place)
            os.replace(source, target)
    for changed in {folder, *((folder / name).parent for name in (*stale, *new))}:
        flush_folder(changed)
    (place / PLAN).unlink()
    flush_folder(place)
    clear(place)


def settle(folder: Path) -> None:
    """Finishes a writing of this folder, or of the folder around it, that was killed while files moved.

    Readers call it before they open anything.

    Raises: ValueError: another process is still moving files, or this one may not write there.
    """
    own = Path(os.path.realpath(folder))
    for each in (own, own.parent):
        if (each / MARK / PLAN).exists():
            _finish(each)


def reclaim(folder: Path) -> None:
    """Settles a folder, and takes away what a killed writer left in it; for whoever goes on to write there.

    Raises: ValueError: another process is writing there. OSError: nothing can be removed there.
    """
    settle(folder)
    place = folder / MARK
    if place.is_dir():
        with held(place, folder, "a folder"):  # which clears it
            pass


def _finish(folder: Path) -> None:
    place, begun = folder / MARK, time.monotonic()
    while (place / PLAN).exists():
        try:
            with held(place, folder, "a folder"):
                carry_out(place, folder)
        except BeingWrittenError:
            if time.monotonic() - begun > PATIENCE:
                raise
            time.sleep(0.01)
        except FileNotFoundError as error:
            raise _damaged(place / PLAN, folder) from error
        except OSError as error:
            raise ValueError(
                f"{folder} is between two results: its writer was ended while files moved, and they cannot be moved "
                f"from here ({error.strerror}). Give permission to write there and read it again."
            ) from None


def _put_aside(path: Path, place: Path) -> None:
    if os.path.lexists(path):
        os.replace(path, place / OLD / uuid.uuid4().hex)


def _write_plan(place: Path, folder: Path, earlier: tuple[str, ...], last: str | None, merged: Collection[str]) -> None:
    new = {name: place / NEW / name for name in _names(place / NEW, folder, merged)}
    others = [name for name in _names(folder, folder, merged) if name not in new]
    stale = sorted(name for name in others if any(fnmatchcase(name, pattern) for pattern in earlier))
    order = sorted(new, key=lambda name: (name == last, new[name].is_file(), name))
    part = place / NEW / f".{PLAN}"
    part.write_text(json.dumps({"stale": stale, "new": order}), encoding="utf-8")
    flush(part)
    flush_folder(place / NEW)
    os.replace(part, place / PLAN)
    flush_folder(place)


def _read_plan(path: Path, folder: Path) -> tuple[list[str], list[str]]:
    """Names of what goes and of what comes. A folder from elsewhere may hold a plan that nobody here has written."""
    try:
        plan = read_json(path)
        stale, new = ([str(name) for name in plan[kind]] for kind in ("stale", "new"))
    except (ValueError, KeyError, TypeError):
        stale, new = [""], []
    links = any((path.parent / name).is_symlink() for name in (".", NEW, OLD))
    for name in (*stale, *new):
        parts = name.split("/")
        leads_away = links or len(parts) > 2 or (len(parts) == 2 and (folder / parts[0]).is_symlink())
        if leads_away or {"", ".", "..", MARK} & set(parts) or "\0" in name:
            raise _damaged(path, folder)
    return stale, new


def _damaged(path: Path, folder: Path) -> ValueError:
    return ValueError(
        f"{path} must be the plan of a writing that was ended while files moved, with names in this folder; it is "
        f"damaged or from elsewhere. Delete {path.parent}, and make the content of {folder} anew."
    )


def _names(within: Path, folder: Path, merged: Collection[str]) -> Iterator[str]:
    """Names of the entries, and those in folders that are merged with one that exists, as in `shots/labels.csv`."""
    for entry in within.iterdir():
        there = folder / entry.name
        if entry.name in merged and entry.is_dir() and there.is_dir() and not there.is_symlink():
            yield from (f"{entry.name}/{inner.name}" for inner in entry.iterdir() if inner.name != MARK)
        elif entry.name != MARK:
            yield entry.name
