"""Where machine code is kept from one process to the next, whatever may be read and written there."""

from __future__ import annotations

import atexit
import hashlib
import os
import pickle
import shutil
import stat
import tempfile
import uuid
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile

PRIVATE: Final = 0o700
DIGEST_SIZE: Final = hashlib.sha256().digest_size
_LOCATORS: Final[dict[str, Any]] = {
    locator.__name__.lstrip("_"): locator for locator in CompileResultCacheImpl._locator_classes
}  # some versions of numba begin these names with a line
_InTree: Any = _LOCATORS["InTreeCacheLocator"]


def configured_folder() -> Path:
    """`BALLFG_CACHE`, else the user's cache; it may not exist. Raises: RuntimeError: the user has no home."""
    base = os.environ.get("BALLFG_CACHE") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "ballfg"


@lru_cache(maxsize=1)
def cache_folder() -> Path:
    """The folder that compiled functions are written to: the configured one, or one for temporary files."""
    try:
        folder = configured_folder()
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, RuntimeError):
        folder = _temporary_folder()
    return folder


def _temporary_folder() -> Path:
    """One that later processes of this user find again; where anybody else could write to it, one for this process."""
    user = os.getuid()
    folder = Path(tempfile.gettempdir()) / f"ballfg-{user}"
    with suppress(FileExistsError):
        folder.mkdir(PRIVATE)
    found = folder.lstat()  # of a link: the link's own
    if stat.S_ISDIR(found.st_mode) and found.st_uid == user and stat.S_IMODE(found.st_mode) == PRIVATE:
        return folder
    folder = Path(tempfile.mkdtemp(prefix="ballfg-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def readable(name: str) -> list[Path]:
    """Where a kept file may be found: a folder that an administrator has filled is read though nothing is written."""
    with suppress(RuntimeError):
        return list(dict.fromkeys((configured_folder() / name, cache_folder() / name)))
    return [cache_folder() / name]


def keep(name: str, text: str) -> Path:
    """Write a file to the cache at once: another process never reads half of it. Returns: its path."""
    path = cache_folder() / name
    part = path.with_name(f"{name}.{uuid.uuid4().hex}.part")  # tempfile's would be closed to other users
    try:
        part.write_text(text, encoding="utf-8")
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)  # of a disk that is full
    return path


class _Temporary(_InTree):
    """A place in `cache_folder`, for code whose own folder and whose user's cache cannot be written to."""

    def __init__(self, function: Any, file: str) -> None:
        super().__init__(function, file)
        self._cache_path = str(cache_folder() / self.get_suitable_cache_subpath(file))


class _Beside(_InTree):
    """The folder beside the source, which need not be one that can be written to."""

    def ensure_cache_path(self) -> None:
        """Nothing is needed to read."""


WRITTEN: Final[list[type[object]]] = [*CompileResultCacheImpl._locator_classes, _Temporary]
READ: Final[list[type[object]]] = [_Beside]


class _Written(CompileResultCacheImpl):
    _locator_classes = WRITTEN


class _Read(CompileResultCacheImpl):
    _locator_classes = READ


class _Digested(IndexDataCacheFile):
    """Files of machine code, each with the digest of the rest: damaged code ends the process, or computes nonsense."""

    def _save_data(self, name: str, data: Any) -> None:
        content = self._dump(data)
        with self._open_for_write(self._data_path(name)) as file:
            file.write(_digest(content) + content)

    def _load_data(self, name: str) -> Any:
        content = Path(self._data_path(name)).read_bytes()
        digest, code = content[:DIGEST_SIZE], content[DIGEST_SIZE:]
        if digest != _digest(code):
            raise ValueError(f"{name} must hold what was written; its digest is another. It is compiled again.")
        return pickle.loads(code)


def _digest(content: bytes) -> bytes:
    return hashlib.sha256(content).digest()


class _Cache(FunctionCache):
    def __init__(self, function: Any) -> None:
        super().__init__(function)
        stamp = self._impl.locator.get_source_stamp()
        self._cache_file = _Digested(self.cache_path, self._impl.filename_base, stamp)


class _KeptBeside(_Cache):
    _impl_class: Any = _Read


class Kept(_Cache):
    """Machine code of a function on disk.

    It is written to the first folder that numba can write to, and read from beside the source too, where whoever
    installed the package may have compiled it; `NUMBA_CACHE_DIR` is the only folder where it is set. What cannot be
    read, or is damaged, as after a power failure, is made again; a full disk costs time.
    """

    _impl_class: Any = _Written

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        beside = _KeptBeside(function)
        told = isinstance(self._impl.locator, _LOCATORS["UserProvidedCacheLocator"])
        self._beside = None if told or beside.cache_path == self.cache_path else beside

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The code that was kept; None where there is none."""
        found = self._loaded(super(), sig, target_context)
        if found is None and self._beside is not None:
            found = self._loaded(self._beside, sig, target_context)
        return found

    def _loaded(self, cache: Any, sig: Any, target_context: Any) -> Any:
        try:
            return cache.load_overload(sig, target_context)
        except Exception:  # pickle's, of any class, at an index that is empty or cut; that of the digest
            with suppress(OSError):
                cache.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep code for other processes."""
        with suppress(OSError):
            super().save_overload(sig, data)
