"""Writes and reads folders as a whole: their files get their names only when all are complete."""

import ctypes
import errno
import os
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from fnmatch import fnmatchcase
from functools import wraps
from pathlib import Path
from typing import Final, ParamSpec, TypeVar

from ballfg.files.held import MARK, NEW, OLD, held, hidden, is_hidden
from ballfg.files.whole_file import check_parent, flush

P = ParamSpec("P")
T = TypeVar("T")

DEEPEST: Final = 100  # largest depth of folders in a result


@contextmanager
def whole_folder(folder: Path, *, earlier: Iterable[str] = (), argument: str = "out") -> Iterator[Path]:
    """A hidden folder for writing; its content is in `folder` when the block ends well.

    After an exception, Ctrl-C or a kill `folder` holds the old result or the new one: an existing folder is exchanged,
    in one step, for a new one that holds its other files too. A disk that cannot exchange folders needs two steps.

    Args:
        folder: its parent must exist.
        earlier: names of entries, or patterns of them, that an earlier result may have, such as `a` or `shots/a`;
            entries that are not written again are removed.
        argument: the folder's name in a message.
    Raises: FileNotFoundError: the parent does not exist. ValueError: `folder` is a file, or one that cannot be
        exchanged, or another process writes it. OSError: it cannot be written; `folder` is named.
    """
    target, patterns = _exchangeable(folder, argument), tuple(earlier)
    if is_hidden(target):
        target.mkdir(exist_ok=True)
        yield target
        return
    with held(target, argument), hidden(target.parent, target, folder) as place:
        stage = place / NEW
        stage.mkdir()
        yield stage
        ours = {str(path.relative_to(stage)) for path in stage.rglob("*")}
        for name in (*ours, ""):
            flush(stage / name)
        if not target.exists():
            os.rename(stage, target)
        else:
            for path, there, _ in _staying(target, stage, patterns):
                if not os.path.lexists(there):
                    try:
                        os.link(path, there, follow_symlinks=False)
                    except OSError:  # a disk on which each file has one name
                        shutil.copy2(path, there, follow_symlinks=False)
            for path, there, name in _staying(_put(place, target), target, patterns):
                if name not in ours and not (
                    os.path.lexists(there) and path.lstat().st_mtime_ns == there.lstat().st_mtime_ns
                ):
                    os.replace(path, there)  # another process has written it meanwhile
            os.utime(target)
        flush(target.parent)


@contextmanager
def reserved(folder: Path, argument: str = "out") -> Iterator[None]:
    """Keeps other processes of this user from writing a folder until the block ends; `whole_folder` within it may.

    Long work begins with it, so that an unusable folder, or one that another process writes, is refused before the
    work.

    Raises: as `whole_folder`.
    """
    target = check_folder(folder, argument)
    with held(target, argument):
        with hidden(target if target.exists() else target.parent, target, folder):
            pass
        yield


def check_folder(folder: Path, argument: str = "out") -> Path:
    """The folder without links. Raises: FileNotFoundError: no parent. ValueError: a file, or a link to nowhere."""
    check_parent(folder, argument)
    if os.path.lexists(folder) and not folder.is_dir():
        raise ValueError(f"{argument} must be a folder; {folder} is a file. Choose another name.")
    return Path(os.path.realpath(folder))


def check_replaceable(
    folder: Path,
    *,
    mark: str,
    what: str,
    only: Collection[str] | None = None,
    force: bool = True,
    is_mark: Callable[[Path], bool] = Path.is_file,
) -> None:
    """Refuses a folder with content that must not be lost; a new or an empty one is fine.

    Args:
        folder: the output.
        mark: name of the file that identifies an earlier result.
        what: name of such a result in a message.
        only: all names that an earlier result can have; None: other files may lie beside it.
        force: True to replace an earlier result.
        is_mark: distinguishes the mark from a foreign file of that name.
    Raises: ValueError: other content, or an earlier result and no `force`; else as `whole_folder`.
    """
    target = _exchangeable(folder, "out")
    with held(target):  # restores the remains of an exchange in two steps
        names = {entry.name for entry in target.iterdir()} if target.exists() else set()
        present = {name for name in names if not name.startswith(MARK)}
        if present and (not is_mark(folder / mark) or (only is not None and not present <= set(only))):
            raise ValueError(f"out must be new, empty or hold {what}; {folder} holds other files. Choose another name.")
        if present and not force:
            raise ValueError(f"out must be new or empty; {folder} holds {what}. Replace it with --force.")
        with hidden(target.parent, target, folder):  # refuses a folder that cannot be written to
            pass


def _exchangeable(folder: Path, argument: str) -> Path:
    """The folder without links. Raises: ValueError: one that cannot be moved; else as `check_folder`."""
    target = check_folder(folder, argument)
    with suppress(FileNotFoundError):  # the current folder may have been removed
        if os.path.ismount(target) or target in (here := Path.cwd(), *here.parents):
            raise ValueError(
                f"{argument} must be a folder that can be exchanged for a new one; {folder} is mounted, or the current "
                "folder is in it. Name a folder in it, or go to its parent."
            )
    return target


def _staying(old: Path, new: Path, patterns: Collection[str]) -> Iterator[tuple[Path, Path, str]]:
    """The files of an earlier result that stay: file, new place, name. Raises: OSError: one is mounted, or too deep."""
    folders = [""]
    for within in folders:
        if within.count("/") == DEEPEST or (within and os.path.ismount(old / within)):
            raise OSError(errno.EXDEV, "a folder that is mounted or nested too deep stays here", str(old / within))
        (new / within).mkdir(exist_ok=True)
        for entry in list(os.scandir(old / within)):
            name, there = os.path.join(within, entry.name), new / within / entry.name
            if any(fnmatchcase(name, pattern) for pattern in patterns):
                continue
            if not entry.is_dir(follow_symlinks=False):
                yield Path(entry), there, name
            elif there.is_dir() or not os.path.lexists(there):
                folders.append(name)
    for within in reversed(folders):  # inner folders first: the outer one may be read-only
        found = (old / within).stat()
        with suppress(PermissionError):
            os.chown(new / within, found.st_uid, found.st_gid)
        shutil.copystat(old / within, new / within)


def _put(place: Path, target: Path) -> Path:
    """Puts the new folder in the place of the old one. Returns: the new place of the old one."""
    try:
        exchange(place / NEW, target)
    except OSError:
        try:
            os.rename(target, place / OLD)
            os.rename(place / NEW, target)
        except BaseException:  # Ctrl-C between them too
            if not os.path.lexists(target):
                os.rename(place / OLD, target)
            raise
        return place / OLD
    return place / NEW


def exchange(one: Path, other: Path) -> None:
    """Exchanges two folders in one step. Raises: OSError: the system or the disk cannot."""
    system, here, swap = ctypes.CDLL(None, use_errno=True), -100, 2  # AT_FDCWD; RENAME_EXCHANGE, RENAME_SWAP
    first, second = os.fsencode(one), os.fsencode(other)
    if hasattr(system, "renameat2"):
        failed = system.renameat2(here, first, here, second, swap)
    else:
        failed = not hasattr(system, "renamex_np") or system.renamex_np(first, second, swap)  # macOS
    if failed:
        raise OSError(ctypes.get_errno(), "folders cannot be exchanged", str(other))


def of_one_state(read: Callable[P, T]) -> Callable[P, T]:
    """A reader that repeats if the folder, or that of the file, in its first argument was exchanged meanwhile."""

    @wraps(read)
    def steady(*args: P.args, **kwargs: P.kwargs) -> T:
        path = next(iter((*args, *kwargs.values())), None)
        if not isinstance(path, str | os.PathLike) or not os.path.exists(path):
            return read(*args, **kwargs)
        folder = path if os.path.isdir(path) else os.path.dirname(path) or "."
        opened = os.open(folder, os.O_DIRECTORY | getattr(os, "O_PATH", os.O_RDONLY))
        try:  # while it is open, no other folder gets its number
            result = read(*args, **kwargs)
        except (OSError, ValueError):
            if _is_at(folder, opened):
                raise
        else:
            if _is_at(folder, opened):
                return result
        finally:
            os.close(opened)
        return steady(*args, **kwargs)

    return steady


def _is_at(folder: str | os.PathLike[str], opened: int) -> bool:
    return os.path.isdir(folder) and os.path.samestat(os.fstat(opened), os.stat(folder))
