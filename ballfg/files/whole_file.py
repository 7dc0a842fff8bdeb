"""Writes a file as a whole: it gets its name only when it is complete."""

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ballfg.files.held import held, hidden, is_hidden


@contextmanager
def whole_file(path: Path, argument: str = "out") -> Iterator[Path]:
    """A path in a hidden folder, with the same name, for writing; it replaces the file when the block ends well.

    After an exception, Ctrl-C or a kill the previous file is untouched. A new file gets the mode of the one that it
    replaces. A link stays, and its target is replaced.

    Raises: FileNotFoundError: the folder of the path does not exist. ValueError: the path is a folder, a device, or a
        link that leads nowhere, or another process is writing it. OSError: it cannot be written; the path is named.
    """
    check_file(path, argument)
    target = Path(os.path.realpath(path))
    if is_hidden(target):
        yield path
        return
    with held(target, argument), hidden(target.parent, target, path) as place:
        temporary = place / path.name
        yield temporary
        with suppress(FileNotFoundError):  # the owner and the mode of the file that it replaces
            found = target.stat()
            with suppress(PermissionError):
                os.chown(temporary, found.st_uid, found.st_gid)
            os.chmod(temporary, stat.S_IMODE(found.st_mode) & 0o777)
        flush(temporary)
        os.replace(temporary, target)
        flush(target.parent)


def write_text(path: Path, text: str) -> None:
    """Writes a text file in UTF-8 as a whole. Raises: as `whole_file`."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def flush(path: Path) -> None:
    """Flushes a file, or the names in a folder, to the disk: else a power cut leaves a name without content."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:  # some disks have no such call for folders, and do it in their own way
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(handle)


def check_file(path: Path, argument: str = "out") -> None:
    """Refuses a path that cannot become a file.

    Raises: FileNotFoundError: its folder does not exist. ValueError: it is a folder, a device such as /dev/null, which
        a file would replace, or a link that leads nowhere.
    """
    check_parent(path, argument)
    if path.is_dir():
        raise ValueError(f"{argument} must be a file; {path} is a folder. Give the name of a file in it.")
    if os.path.lexists(path) and not path.is_file():
        what = "a device or a pipe" if path.exists() else "a link that leads nowhere"
        raise ValueError(f"{argument} must be a file; {path} is {what}. Give the name of a file.")


def check_parent(path: Path, argument: str) -> None:
    """Refuses a path in a folder that does not exist. Raises: FileNotFoundError."""
    if not path.absolute().parent.is_dir():
        raise FileNotFoundError(f"{argument} must be in an existing folder; {path.parent} is none. Create it first.")
