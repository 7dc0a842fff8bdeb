"""Writing a folder as a whole: its files have their names only when all of them are complete."""

import os
import shutil
import uuid
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path

from ballfg.files.whole_file import check_parent, flush


@contextmanager
def whole_folder(
    folder: Path, *, earlier: Iterable[str] = (), last: str | None = None, argument: str = "out"
) -> Iterator[Path]:
    """A hidden folder to write to; what it holds moves into `folder` when the block ends well.

    A new folder appears at once. In one that exists each entry is replaced in turn, and other files stay. After an
    exception or Ctrl-C what was there before is untouched.

    Args:
        folder: its parent must exist.
        earlier: names, or patterns of names, that an earlier result may have; those that are not written again are
            removed.
        last: name of the file that is moved last: where it is, the others are whole.
        argument: the folder's name in a message.
    Raises: FileNotFoundError: the parent does not exist. ValueError: `folder` is a file.
    """
    with staging(folder, argument) as stage:
        yield stage
        for path in stage.rglob("*"):
            if path.is_file():
                flush(path)
        if folder.exists():
            _publish(stage, folder, earlier, last)
        else:
            os.rename(stage, folder)


@contextmanager
def staging(folder: Path, argument: str = "out") -> Iterator[Path]:
    """A hidden folder in `folder`, or beside it if it does not exist; gone when the block ends.

    Raises: FileNotFoundError: the parent does not exist. ValueError: `folder` is a file. OSError: it cannot be made.
    """
    check_folder(folder, argument)
    name = f".writing-{uuid.uuid4().hex[:8]}"
    stage = folder / name if folder.exists() else folder.with_name(f".{folder.name}{name}")
    try:
        stage.mkdir()
        yield stage
    finally:
        shutil.rmtree(stage, ignore_errors=True)


def check_folder(folder: Path, argument: str = "out") -> None:
    """Refuses a path at which no folder can be made or written to.

    Raises: FileNotFoundError: its parent does not exist. ValueError: it is a file.
    """
    check_parent(folder, argument)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{argument} must be a folder; {folder} is a file. Choose another name.")


def check_replaceable(
    folder: Path, *, mark: str, what: str, only: Collection[str] | None = None, force: bool = True
) -> None:
    """Refuses a folder that holds something that must not be lost; a new or an empty one never does.

    Args:
        folder: to write to.
        mark: name of the file that tells an earlier result.
        what: such a result is called in a message.
        only: all names that an earlier result can have; None: other files may lie beside it.
        force: an earlier result may be replaced.
    Raises: ValueError: other content, or an earlier result and no `force`; else as `check_folder`.
    """
    check_folder(folder)
    present = {entry.name for entry in folder.iterdir()} if folder.exists() else set()
    if not present:
        return
    if not (folder / mark).is_file() or (only is not None and not present <= set(only)):
        raise ValueError(f"out must be new, empty or hold {what}; {folder} holds other files. Choose another name.")
    if not force:
        raise ValueError(f"out must be new or empty; {folder} holds {what}. Replace it with --force.")


@contextmanager
def replaced_folder(folder: Path) -> Iterator[Path]:
    """A hidden folder to write to, which takes the place of `folder` with all that it holds.

    At every moment the old or the new one is there, whole: under its name, or where `recover` brings it back.
    One process at a time writes a folder in this way.

    Args: folder: its parent must exist.
    """
    stage = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(stage, ignore_errors=True)
    stage.mkdir()
    try:
        yield stage
        for path in stage.iterdir():
            flush(path)
        recover(folder)
        if folder.exists():
            os.replace(folder, _aside(folder))
        os.replace(stage, folder)
    finally:
        shutil.rmtree(stage, ignore_errors=True)
        recover(folder)


def recover(folder: Path) -> None:
    """Clears the old folder of `replaced_folder` away, or takes it back if a crash came before the new one."""
    old = _aside(folder)
    if not old.exists():
        return
    if folder.exists():
        shutil.rmtree(old)
    else:
        os.replace(old, folder)


def _aside(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.old")


def _publish(stage: Path, folder: Path, earlier: Iterable[str], last: str | None) -> None:
    """Moves the entries of `stage` to their names in `folder`.

    Files that are out of date go first. Folders that are go at the end: until then an earlier file may refer to one.
    """
    new = {path.name: path for path in stage.iterdir()}
    patterns = tuple(earlier)
    others = [path for path in folder.iterdir() if path != stage and path.name not in new]
    stale = [path for path in others if any(fnmatchcase(path.name, pattern) for pattern in patterns)]
    for path in stale:
        if not path.is_dir():
            path.unlink()
    for name in sorted(new, key=lambda name: (name == last, new[name].is_file(), name)):
        target = folder / name
        if target.is_dir() or (target.exists() and new[name].is_dir()):
            os.replace(target, stage / f".old-{name}")
        os.replace(new[name], target)
    for path in stale:
        if path.is_dir():
            shutil.rmtree(path)
