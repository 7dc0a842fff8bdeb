"""Gives folders that only this user can change, for locks and for machine code."""

import atexit
import grp
import os
import pwd
import shutil
import stat
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Final

PRIVATE: Final = 0o700
_ROOT: Final = 0


def state_folder(name: str) -> Path:
    """The folder of this user's state under `name`, created if missing.

    Returns: `$XDG_STATE_HOME/ballfg/name`, by default in `~/.local/state`; if that cannot be written to, or if others
        can, a folder of this user among the temporary files.
    """
    try:
        base = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
        return own_folder(Path(base) / "ballfg" / name)
    except (OSError, RuntimeError, ValueError):  # read-only, no home, or not this user's
        return temporary_folder(name)


def own_folder(folder: Path) -> Path:
    """The folder, made for this user alone if missing. Raises: OSError: unusable. ValueError: others may change it."""
    folder.mkdir(parents=True, exist_ok=True, mode=PRIVATE)
    if not is_own(folder):
        raise ValueError(f"{folder} must be a folder that only this user may write to. Change its owner and its mode.")
    with tempfile.TemporaryFile(dir=folder):
        return folder


def temporary_folder(name: str) -> Path:
    """A temporary folder that later processes of this user find; of this process if another user has the name."""
    folder = Path(tempfile.gettempdir()) / f"ballfg-{os.getuid()}" / name
    with suppress(OSError):
        for each in (folder.parent, folder):
            with suppress(FileExistsError):
                each.mkdir(PRIVATE)
        if is_own(folder) and not folder.parent.is_symlink():
            return folder
    folder = Path(tempfile.mkdtemp(prefix="ballfg-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def is_own(folder: Path) -> bool:
    """True if only this user and root can change a folder's content, or replace the folder.

    The folder belongs to this user or to root, and so do all folders around it; others may write to none of them,
    except with a sticky bit that protects the files of others, as in /tmp. Links of this user and of root are followed,
    and their targets judged; other users could change theirs at any time.
    """
    try:
        real = Path(os.path.realpath(folder, strict=True))
        return (
            _is_closed(real.stat(), sticky=False)
            and all(_is_closed(each.stat(), sticky=True) for each in real.parents)
            and all(each.lstat().st_uid in (_ROOT, os.geteuid()) for each in (folder, *folder.absolute().parents))
        )
    except OSError:
        return False


def own_bytes(path: Path) -> bytes:
    """The content of a file that only this user and root can change. Raises: OSError. ValueError: others can."""
    with open(path, "rb") as file:
        found = os.fstat(file.fileno())
        own = stat.S_ISREG(found.st_mode) and found.st_uid in (_ROOT, os.geteuid())
        if not own or found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            raise ValueError(f"{path} must be a file that only this user may write to. Change its owner and its mode.")
        return file.read()


def _is_closed(found: os.stat_result, *, sticky: bool) -> bool:
    """True if a folder belongs to this user or root, and no other user can rename its content."""
    if not stat.S_ISDIR(found.st_mode) or found.st_uid not in (_ROOT, os.geteuid()):
        return False
    if sticky and found.st_mode & stat.S_ISVTX:
        return True
    if found.st_mode & stat.S_IWGRP and not _is_group_of_one(found.st_gid):
        return False
    return not found.st_mode & stat.S_IWOTH


def _is_group_of_one(group: int) -> bool:
    """True if this user, or root, is a group's only member: many systems give each user such a group."""
    try:
        entry, user = grp.getgrgid(group), pwd.getpwuid(os.geteuid())
    except KeyError:
        return False
    return (
        group in (_ROOT, user.pw_gid)
        and entry.gr_name in ("root", user.pw_name)
        and set(entry.gr_mem) <= {user.pw_name}
    )
