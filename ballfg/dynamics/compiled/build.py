"""From a scalar program to a compiled function, kept on disk under the hash of its source."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import sys
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache, lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from numba import njit
from numba.core.caching import FunctionCache
from numba.core.types import WrapperAddressProtocol
from numba.extending import typeof_impl

from ballfg.dynamics.compiled.signatures import FUNCTION
from ballfg.files.json_file import read_json
from ballfg.progress import doing

HEADER: Final = '''"""Generated from a model of a ball; safe to delete."""
import math

import numpy as np
from numba import types

from ballfg.dynamics.compiled.build import machine_code
{imports}
ONE, TWO, THREE = (types.Array(types.float64, dimensions, "C") for dimensions in (1, 2, 3))


@machine_code(types.void(TWO, TWO, ONE, THREE, THREE, TWO, THREE))
'''
"""What comes before `compute` in a file."""
HELPERS: Final = ("add_product", "tanh_all")
"""Functions of `layers.py` that generated ones may call."""


class _Kept(FunctionCache):
    """Machine code on disk. What cannot be read, as after a power failure, is made again; a full disk costs time."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # pickle's, of any class, at a file that is empty or cut
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        with suppress(OSError):
            super().save_overload(sig, data)


def machine_code(signature: Any) -> Callable[[Callable[..., Any]], Any]:
    """Numba's compiler for one signature; kept on disk where any folder for that can be written to.

    A function is compiled, or loaded, when it is first called or built into another one: a process pays for what it
    uses.
    """

    def declared(function: Callable[..., Any]) -> Any:
        dispatcher: Any = njit(error_model="numpy")(function)  # numba's own would look for a zero in every division
        with suppress(RuntimeError):  # no folder: compiled anew by every process
            dispatcher._cache = _Kept(function)

        def for_call(*_: Any, **__: Any) -> Any:
            """The machine code, which numba asks for at the first call from Python."""
            del dispatcher._compile_for_args, dispatcher.get_call_template
            with doing("compiling machine code, once on this machine"):
                entry = dispatcher.compile(signature)
            dispatcher.disable_compile()  # as of a function whose signature numba is given at once
            return entry

        def for_caller(args: Any, kwargs: Any) -> Any:
            """What numba asks for when it compiles a function that calls this one."""
            for_call()
            return dispatcher.get_call_template(args, kwargs)

        dispatcher._compile_for_args, dispatcher.get_call_template = for_call, for_caller
        return dispatcher

    return declared


class Code(WrapperAddressProtocol):
    """A compiled function as machine code takes it: by its address, which numba would look up anew in every call."""

    def __init__(self, compiled: Any) -> None:
        self.__wrapped__ = compiled
        (self._signature,) = compiled.nopython_signatures
        result = compiled.get_compile_result(self._signature)
        self._address = result.library.get_pointer_to_function(result.fndesc.llvm_cfunc_wrapper_name)

    def __call__(self, *args: Any) -> None:
        """Call it from Python."""
        self.__wrapped__(*args)

    def __wrapper_address__(self) -> int:
        return int(self._address)

    def signature(self) -> Any:
        """Of its arguments and result, as numba asks for it."""
        return self._signature


@typeof_impl.register(Code)
def _type_of(code: Code, _context: Any) -> Any:
    return FUNCTION


def built(source: str) -> Code:
    """The compiled `compute` of some source."""
    called, imports = [helper for helper in HELPERS if f"{helper}(" in source], ""
    if called:  # the hash of their file: code that was compiled with another one is not found
        file = Path(__file__).with_name("layers.py")
        imports = f"from ballfg.dynamics.compiled.layers import {', '.join(called)}  # {digest(file)}\n"
    return _built(HEADER.format(imports=imports) + source)


@cache
def _built(text: str) -> Code:
    name = f"ballfg_compiled_{hashlib.sha256(text.encode()).hexdigest()[:20]}"
    path = cache_folder() / f"{name}.py"
    if not _holds(path, text):
        _write(path, text)
    compute = _imported(name, path).compute
    compute._compile_for_args()
    return Code(compute)


def _holds(path: Path, text: str) -> bool:
    """Whether a file has this content, whole."""
    try:
        return path.read_bytes() == text.encode()
    except OSError:
        return False


@cache
def digest(file: Path) -> str:
    """Hash of a file's content."""
    return hashlib.sha256(file.read_bytes()).hexdigest()[:12]


def write_note(about: str, note: Mapping[str, Any]) -> None:
    """Keep a note on disk for other processes."""
    _write(_note_path(about), json.dumps({"note": note, "digest": _digest_of(note)}))


def read_note(about: str) -> Any | None:
    """A note that was kept; None where there is none, or a damaged one."""
    try:
        kept = read_json(_note_path(about))
    except (OSError, ValueError):
        return None
    whole = isinstance(kept, dict) and "note" in kept and kept.get("digest") == _digest_of(kept["note"])
    return kept["note"] if whole else None


def _digest_of(note: Any) -> str:
    return hashlib.sha256(json.dumps(note).encode()).hexdigest()


def _note_path(about: str) -> Path:
    return cache_folder() / f"{hashlib.sha256(about.encode()).hexdigest()[:20]}.json"


@lru_cache(maxsize=1)
def cache_folder() -> Path:
    """The folder of compiled functions: `BALLFG_CACHE`, else the user's cache, else a temporary one."""
    try:
        base = os.environ.get("BALLFG_CACHE") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(base) / "ballfg"
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, RuntimeError):  # RuntimeError: the user has no home
        folder = Path(tempfile.mkdtemp(prefix="ballfg-"))
    return folder


def _write(path: Path, text: str) -> None:
    """At once: another process never reads half a file."""
    with tempfile.NamedTemporaryFile("w", dir=path.parent, suffix=".part", delete=False) as file:
        file.write(text)
    os.replace(file.name, path)


def _imported(name: str, path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module
