"""Keeps machine code on disk from one process to the next, in folders that nobody else can change.

Machine code is run as it is found. So it is read only from folders that this user and root alone can change, and each
file states its function, its sources, their versions and the processor.
"""

import hashlib
import os
import pickle
import re
import sys
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache, lru_cache
from io import BytesIO
from pathlib import Path
from typing import IO, Any, Final

import llvmlite
import llvmlite.binding as llvm
import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile
from numba.core.codegen import JITCodeLibrary
from numba.core.runtime import rtsys

from ballfg.files.own_folder import is_own, own_bytes, temporary_folder

READABLE: Final = 0o755  # Mode of the folder of the cache: others may read what an administrator has compiled for them
FOR_OTHERS_TO_READ: Final = 0o644
DIGEST_SIZE: Final = hashlib.sha256().digest_size
NOTED: Final = "BALLFG_CACHE_NOTED"
"""Environment variable: this process, or one that started it, has printed the note on folders that are not used."""
_IMPORTS: Final = re.compile(rb"^(?:from|import) (ballfg[\w.]*)", re.MULTILINE)
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
    with suppress(OSError, RuntimeError):
        folder = configured_folder()
        folder.mkdir(READABLE, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            if _is_trusted(folder):
                return folder
    return temporary_folder("cache")


@cache
def _is_trusted(folder: Path) -> bool:
    """True if machine code in a folder may be run; else the first such folder is named on stderr."""
    trusted = is_own(folder)
    if not trusted and NOTED not in os.environ and sys.stderr is not None:
        os.environ[NOTED] = "1"
        print(
            f"note: {folder} is not used for machine code, since others than this user may change it, or a folder "
            "around it; what is missing is compiled anew",
            file=sys.stderr,
        )
    return trusted


def readable(name: str) -> list[Path]:
    """Path of a kept file; a folder that an administrator has filled is read though nothing is written to it."""
    folders = [cache_folder()]
    with suppress(RuntimeError):
        if _is_trusted(configured_folder()):
            folders.insert(0, configured_folder())
    return [folder / name for folder in dict.fromkeys(folders)]


def keep(name: str, text: str) -> Path:
    """Writes a file to the cache atomically: another process never reads half of it. Returns: its path."""
    path = cache_folder() / name
    with _replaced(path) as file:
        file.write(text.encode())
    return path


@contextmanager
def _replaced(path: Path) -> Iterator[IO[bytes]]:
    """A new file that replaces another one; only this user may change it."""
    part = path.with_name(f"{path.name}.{uuid.uuid4().hex}.part")
    try:
        with open(part, "wb", opener=lambda name, flags: os.open(name, flags, FOR_OTHERS_TO_READ)) as file:
            yield file
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)  # of a disk that is full, or after an interrupt


class _Temporary(_InTree):
    """A place in `cache_folder`, for code whose own folder and whose user's cache cannot be written to."""

    def __init__(self, function: Any, file: str) -> None:
        super().__init__(function, file)
        self._cache_path = str(cache_folder() / self.get_suitable_cache_subpath(file))


class _Beside(_InTree):
    """The folder beside the source, which need not be one that can be written to."""

    def ensure_cache_path(self) -> None:
        """Nothing is needed to read."""


class _Trusted:
    """A locator of numba's that ignores folders in which somebody else could change the code."""

    def __init__(self, locator: Any) -> None:
        self._locator = locator

    def from_function(self, function: Any, file: str) -> Any:
        """As numba asks for it; None where there is no such folder."""
        found = self._locator.from_function(function, file)
        return found if found is not None and _is_trusted(Path(found.get_cache_path())) else None


WRITTEN: Final[list[Any]] = [_Trusted(locator) for locator in (*CompileResultCacheImpl._locator_classes, _Temporary)]
READ: Final[list[Any]] = [_Beside]


class _Library(JITCodeLibrary):
    """A loaded function, whose code for building it into others is read when one of them is compiled.

    A program that only calls it would spend half of the time of loading on that.
    """

    _waiting: bytes | None

    def _get_module_for_linking(self) -> Any:
        if self._waiting is not None:
            self._shared_module, self._waiting = llvm.parse_bitcode(self._waiting), None
            self._codegen._engine._load_defined_symbols(self._shared_module)
        return super()._get_module_for_linking()


class _Kept(CompileResultCacheImpl):
    def rebuild(self, target_context: Any, payload: Any) -> Any:
        """The function of kept code, as numba asks for it."""
        (name, kind, (code, shared)), about, *others = payload
        codegen = target_context.codegen()
        codegen._engine._defined_symbols |= {about.llvm_cpython_wrapper_name, about.llvm_cfunc_wrapper_name}
        found = super().rebuild(target_context, ((name, kind, (code, _no_code())), about, *others))
        found.library.__class__, found.library._waiting = _Library, shared
        return found


@cache
def _no_code() -> bytes:
    return bytes(llvm.parse_assembly("").as_bitcode())


class _Written(_Kept):
    _locator_classes = WRITTEN


class _Read(_Kept):
    _locator_classes = READ


class _Checked(IndexDataCacheFile):
    """Files of machine code, each with its key and with a digest of the rest.

    Damaged code, or another function's, would end the process or compute nonsense.
    """

    def __init__(self, folder: str, base: str, stamp: str) -> None:
        super().__init__(folder, base, stamp)
        self._version = f"numba {numba.__version__}, llvmlite {llvmlite.__version__}"
        self._about = f"{base}, {stamp}, {self._version}"

    def save(self, key: Any, data: Any) -> None:
        """Keeps code. Args: key: signature, processor and its features, bytecode."""
        super().save(key, (f"{self._about}, {key}", data))

    def load(self, key: Any) -> Any:
        """The code of a key; None if there is none. Raises: ValueError: the file holds other code."""
        about, data = super().load(key) or ("", None)
        if data is not None and about != f"{self._about}, {key}":
            raise ValueError(f"{self._index_name} must lead to its own code. It is compiled again.")
        return data

    def _load_index(self) -> Any:
        try:
            file = BytesIO(own_bytes(Path(self._index_path)))
        except FileNotFoundError:
            return {}
        if pickle.load(file) != self._version:
            return {}
        stamp, overloads = pickle.load(file)
        return overloads if stamp == self._source_stamp else {}

    def _save_data(self, name: str, data: Any) -> None:
        content = self._dump(data)
        with self._open_for_write(self._data_path(name)) as file:
            file.write(_digest(content) + content)

    def _load_data(self, name: str) -> Any:
        content = own_bytes(Path(self._data_path(name)))
        digest, code = content[:DIGEST_SIZE], content[DIGEST_SIZE:]
        if digest != _digest(code):
            raise ValueError(f"{name} must hold what was written; its digest is another. It is compiled again.")
        return pickle.loads(code)

    def _open_for_write(self, path: str) -> Any:
        return _replaced(Path(path))


def _digest(content: bytes) -> bytes:
    return hashlib.sha256(content).digest()


@cache
def source_stamp(file: str) -> str:
    """Digest of a source file and of all ballfg files that it imports, since their functions are compiled in."""
    found, waiting = dict[str, bytes](), [file]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found[path], imported = _read(path)
            files = (getattr(sys.modules.get(name), "__file__", None) for name in imported)
            waiting += [each for each in files if each is not None]
    return _digest(b"".join(found[path] for path in sorted(found))).hex()


@cache
def _read(path: str) -> tuple[bytes, tuple[str, ...]]:
    """The digest of a source file, and the modules of ballfg that it imports."""
    content = Path(path).read_bytes()
    return _digest(content), tuple(name.decode() for name in _IMPORTS.findall(content))


class _Cache(FunctionCache):
    def __init__(self, function: Any) -> None:
        super().__init__(function)
        file = function.__code__.co_filename
        cell = not os.path.exists(file)  # of a notebook
        stamp = str(self._impl.locator.get_source_stamp()) if cell else source_stamp(file)
        self._cache_file = _Checked(self.cache_path, self._impl.filename_base, stamp)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The kept code; None if there is none.

        numba's own method first loads all that a compilation needs, which takes a fifth of a second. Code that is
        compiled already needs the memory of its arrays alone; a compilation loads the rest itself.
        """
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)


class _KeptBeside(_Cache):
    _impl_class: Any = _Read


class Kept(_Cache):
    """Machine code of a function on disk.

    It is written to the first folder that numba can write to and nobody else can change. It is also read from beside
    the source, where an administrator may have compiled it; if `NUMBA_CACHE_DIR` is set, only from there. Unreadable,
    damaged or foreign code is compiled again; a full disk only costs time.
    """

    _impl_class: Any = _Written

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        told = isinstance(self._impl.locator, _LOCATORS["UserProvidedCacheLocator"])
        beside = Path(function.__code__.co_filename).with_name("__pycache__")
        self._beside: Any = None
        if not told and str(beside) != self.cache_path and any(beside.glob("*.nbi")) and _is_trusted(beside):
            self._beside = _KeptBeside(function)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The kept code; None if there is none."""
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
        """Keeps code for other processes."""
        with suppress(OSError):
            super().save_overload(sig, data)
