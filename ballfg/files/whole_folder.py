"""Writing a folder as a whole: its files have their names only when all of them are complete."""

import os
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ballfg.files.held import MARK, NEW, PLAN, beside, clear, held
from ballfg.files.moving import carry_out, move_in, settle
from ballfg.files.whole_file import check_parent, flush, flush_folder


@contextmanager
def whole_folder(
    folder: Path,
    *,
    earlier: Iterable[str] = (),
    last: str | None = None,
    merged: Collection[str] = (),
    argument: str = "out",
) -> Iterator[Path]:
    """A hidden folder to write to; what it holds moves into `folder` when the block ends well.

    A new folder appears at once. In one that exists each entry is replaced in turn, and other files stay. After an
    exception, Ctrl-C or a kill the folder holds the old result or the new one: where files were moving, the next
    command that writes or reads it moves the rest (`settle`).

    Args:
        folder: its parent must exist.
        earlier: names, or patterns of names, that an earlier result may have; those that are not written again are
            removed.
        last: name of the file that is moved last, for other programs that wait for it.
        merged: names of folders in it whose entries are replaced one by one too, so that other files in them stay;
            `earlier` names their entries as `name/entry`.
        argument: the folder's name in a message.
    Raises: FileNotFoundError: the parent does not exist. ValueError: `folder` is a file, or another process writes it.
    """
    with reserved(folder, argument) as place:
        stage = place / NEW
        target = Path(os.path.realpath(folder))
        try:
            stage.mkdir()
            yield stage
            for path in stage.rglob("*"):
                (flush if path.is_file() else flush_folder)(path)
            flush_folder(stage)
            if place.parent == target:
                move_in(place, target, earlier, last, merged)
            elif target.exists():  # somebody has made it meanwhile
                with reserved(target, argument) as inner:
                    os.rename(stage, inner / NEW)
                    move_in(inner, target, earlier, last, merged)
            else:
                os.rename(stage, target)
                flush_folder(target.parent)
        finally:
            if not (place / PLAN).exists():
                clear(place)


@contextmanager
def reserved(folder: Path, argument: str = "out") -> Iterator[Path]:
    """Keeps other processes from writing a folder until the block ends; `whole_folder` within it may.

    Long work begins with it, so that a folder that cannot be written to, or that another process writes, is refused
    before the work and not after it. A writing that was killed while files moved is finished first.

    Returns: the hidden folder that is locked: in `folder`, or beside it if it does not exist.
    Raises: FileNotFoundError: the parent does not exist. ValueError: `folder` is a file, or another process writes it.
        OSError: nothing can be written there.
    """
    check_folder(folder, argument)
    target = Path(os.path.realpath(folder))
    place = target / MARK if target.exists() else beside(target)
    _end_first(target, folder, argument)
    with held(place, folder, argument):
        carry_out(place, target)
        yield place


def _end_first(target: Path, folder: Path, argument: str) -> None:
    """Clears what a writing that made a new folder left beside it. Raises: ValueError: it has not ended."""
    if target.exists() and beside(target).exists():
        with held(beside(target), folder, argument):
            pass


def check_folder(folder: Path, argument: str = "out") -> None:
    """Refuses a path at which no folder can be made or written to.

    Raises: FileNotFoundError: its parent does not exist. ValueError: it is a file.
    """
    check_parent(folder, argument)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{argument} must be a folder; {folder} is a file. Choose another name.")


def check_replaceable(
    folder: Path,
    *,
    mark: str,
    what: str,
    only: Collection[str] | None = None,
    force: bool = True,
    is_mark: Callable[[Path], bool] = Path.is_file,
) -> None:
    """Refuses a folder that holds something that must not be lost; a new or an empty one never does.

    Args:
        folder: to write to.
        mark: name of the file that tells an earlier result.
        what: such a result is called in a message.
        only: all names that an earlier result can have; None: other files may lie beside it.
        force: an earlier result may be replaced.
        is_mark: tells the mark from a file of that name that something else wrote.
    Raises: ValueError: other content, or an earlier result and no `force`; else as `check_folder`.
    """
    check_folder(folder)
    settle(folder)
    _end_first(Path(os.path.realpath(folder)), folder, "out")
    present = {entry.name for entry in folder.iterdir() if not entry.name.endswith(MARK)} if folder.exists() else set()
    if not present:
        return
    if not is_mark(folder / mark) or (only is not None and not present <= set(only)):
        raise ValueError(f"out must be new, empty or hold {what}; {folder} holds other files. Choose another name.")
    if not force:
        raise ValueError(f"out must be new or empty; {folder} holds {what}. Replace it with --force.")
