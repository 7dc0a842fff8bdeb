"""Keeps machine code on disk from one process to the next, in folders that nobody else can change.

Machine code is run as it is found. So it is read only from folders that this user and root alone can change, and each
file states its function, its sources, their versions and the processor.
"""

import hashlib
import marshal
import os
import pickle
import re
import sys
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache, lru_cache
from pathlib import Path
from typing import IO, Any, Final, cast

import llvmlite
import llvmlite.binding as llvm
import numba
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompileResult
from numba.core.runtime import rtsys
from numba.core.serialize import dumps

from ballfg.files.own_folder import is_own, own_bytes, temporary_folder

READABLE: Final = 0o755  # Mode of the folder of the cache: others may read what an administrator has compiled for them
FOR_OTHERS_TO_READ: Final = 0o644
DIGEST_SIZE: Final = hashlib.sha256().digest_size
NOTED: Final = "BALLFG_CACHE_NOTED"
"""Environment variable: this process, or one that started it, has printed the note on folders that are not used."""
VERSIONS: Final = f"numba {numba.__version__}, llvmlite {llvmlite.__version__}"
_IMPORTS: Final = re.compile(rb"^(?:from|import) (ballfg[\w.]*)(?: import (\([^)]*\)|.*))?", re.MULTILINE)


def configured_folder() -> Path:
    """`BALLFG_CACHE`, else the user's cache; it may not exist. Raises: RuntimeError: the user has no home."""
    base = os.environ.get("BALLFG_CACHE") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "ballfg"


@lru_cache(maxsize=1)
def cache_folder() -> Path:
    """The folder that compiled functions are written to: the configured one, or one for temporary files."""
    with suppress(RuntimeError):
        folder = configured_folder()
        if _is_usable(folder):
            return folder
    return temporary_folder("cache")


@cache
def _is_usable(folder: Path) -> bool:
    """True if machine code can be written to a folder, which is made if missing, and may be run from there."""
    with suppress(OSError):
        folder.mkdir(READABLE, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return _is_trusted(folder)
    return False


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


@cache
def _no_code() -> bytes:
    return bytes(llvm.parse_assembly("").as_bitcode())


def _rebuilt(target_context: Any, payload: Any) -> Any:
    """The function of kept code."""
    (name, kind, (code, shared)), about, *others = payload
    target_context.codegen()._engine._defined_symbols |= {
        about.llvm_cpython_wrapper_name,
        about.llvm_cfunc_wrapper_name,
    }
    found = CompileResult._rebuild(target_context, (name, kind, (code, _no_code())), about, *others)
    found.library.__class__, found.library._waiting = _Library, shared
    return found


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
    """The digest of a source file, and the modules of ballfg that it imports, among other names."""
    content = Path(path).read_bytes()
    modules = list[bytes]()
    for module, names in _IMPORTS.findall(content):  # a name may be that of a module too
        modules += [module, *(module + b"." + name for name in re.findall(rb"\w+", names))]
    return _digest(content), tuple(name.decode() for name in modules)


class Kept:
    """Machine code of a function on disk, in the form that numba asks for it.

    It is written to the folder that numba is told by `NUMBA_CACHE_DIR`; else beside its source, or if that folder
    cannot be written to, or others than this user may change it, to `cache_folder`. It is also read from beside the
    source, where an administrator may have compiled it. Unreadable, damaged or foreign code is compiled again; a full
    disk only costs time.
    """

    def __init__(self, function: Any) -> None:
        code, settings = function.__code__, cast(Any, numba.config)
        assert function.__closure__ is None, "what a function takes from around it would be compiled in"
        source = Path(code.co_filename)
        there, beside = source.exists(), source.with_name("__pycache__")
        told = Path(settings.CACHE_DIR) if settings.CACHE_DIR else None
        stamp = source_stamp(str(source)) if there else _digest(marshal.dumps(code)).hex()  # of a notebook
        place, named = _digest(str(source.parent).encode()).hex()[:12], re.sub(r"\W+", "_", function.__qualname__)
        version = f"py{sys.version_info.major}{sys.version_info.minor}"
        name = f"{source.stem}.{named}-{code.co_firstlineno}.{version}.nbc"
        self._about = f"{name}, {stamp}, {VERSIONS}"
        wanted = [told] if told is not None else [beside] if there else []
        folder = next(filter(_is_usable, wanted), None) or cache_folder()
        self._paths = [folder / (name if folder == beside else f"{place}-{name}")]
        if told is None and folder != beside and (beside / name).exists() and _is_trusted(beside):
            self._paths.append(beside / name)

    @property
    def cache_path(self) -> str:
        """The folder that is written to."""
        return str(self._paths[0].parent)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The kept code; None if there is none.

        numba's own cache first loads all that a compilation needs, which takes a fifth of a second. Code that is
        compiled already needs the memory of its arrays alone; a compilation loads the rest itself.
        """
        rtsys.initialize(target_context)
        about = self._about_code(sig, target_context.codegen())
        for path in self._paths:
            try:
                content = own_bytes(path)
                if content[:DIGEST_SIZE] == _digest(content[DIGEST_SIZE:]):
                    known, payload = pickle.loads(content[DIGEST_SIZE:])
                    if known == about:
                        return _rebuilt(target_context, payload)
            except Exception:  # pickle's, of any class
                continue
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keeps code for other processes, unless it refers to places in the memory of this one."""
        if data.lifted or data.library.has_dynamic_globals:
            return
        content = dumps((self._about_code(sig, data.codegen), data._reduce()))
        with suppress(OSError), _replaced(self._paths[0]) as file:
            file.write(_digest(content) + content)

    def _about_code(self, sig: Any, codegen: Any) -> str:
        """The function, its sources, their versions, its signature and the processor."""
        return f"{self._about}, {sig}, {codegen.magic_tuple()}"
