"""Compiles generated source to machine code and keeps it on disk under the hash of that source."""

import ast
import hashlib
import json
import sys
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from numba import njit
from numba.core import cgutils
from numba.core.compiler_lock import global_compiler_lock
from numba.core.options import DefaultOptions
from numba.extending import intrinsic

from ballfg.dynamics.compiled.arithmetic import lowered
from ballfg.dynamics.compiled.kept import Kept, keep, readable
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


@machine_code(types.void(TWO, TWO, ONE, THREE, THREE, TWO, THREE), makes_arrays={makes_arrays})
'''
"""Beginning of each generated file, before `compute`."""
COUNTS: Final = "_nrt"
"""Numba's option, which its documentation does not name, of code that counts who holds an array. What such code calls
inherits it where nothing is said."""
HELPERS: Final = ("add_product", "tanh_all")  # Functions of `layers.py` that generated ones may call


def machine_code(
    signature: Any, may: Collection[str] = (), *, makes_arrays: bool = True, beside_others: bool = False
) -> Callable[[Callable[..., Any]], Any]:
    """Numba's compiler for one signature; kept on disk for other processes.

    A function is compiled, or loaded, when it is first called or built into another one: a process pays for what it
    uses.

    Args:
        may: what LLVM may do to rounding: "contract", a product and a sum rounded once; "reassoc", sums in any order.
        makes_arrays: False for a function that makes none itself. Numba then does not count who holds those that it is
            given, which takes longer than a short function.
        beside_others: True to let other threads run Python meanwhile, which takes longer than a short function too.
    """

    def declared(function: Callable[..., Any]) -> Any:
        # numba's own error model would look for a zero in every division
        counts: dict[str, Any] = {COUNTS: makes_arrays} if hasattr(DefaultOptions, COUNTS) else {}
        compiler = njit(error_model="numpy", fastmath=set(may), nogil=beside_others, **counts)
        dispatcher: Any = compiler(function)
        dispatcher._cache = Kept(function)

        def for_call(*_: Any, **__: Any) -> Any:
            """The machine code, which numba asks for at the first call from Python."""
            with global_compiler_lock:  # another thread may be here too, and have made it meanwhile
                if "_compile_for_args" in vars(dispatcher):
                    with doing("compiling machine code, once on this machine", resumed=True):
                        entry = dispatcher.compile(signature)
                    dispatcher.disable_compile()  # as of a function whose signature numba is given at once
                    del dispatcher._compile_for_args, dispatcher.get_call_template
                    return entry
                return next(iter(dispatcher.overloads.values())).entry_point

        def for_caller(args: Any, kwargs: Any) -> Any:
            """The machine code, which numba asks for when it compiles a caller of this function."""
            for_call()
            return dispatcher.get_call_template(args, kwargs)

        dispatcher._compile_for_args, dispatcher.get_call_template = for_call, for_caller
        return dispatcher

    return declared


class Code:
    """A compiled function of a model.

    Attributes: address: by which machine code takes it; numba would look for the function's type in every call.
    """

    def __init__(self, compiled: Any) -> None:
        self.__wrapped__ = compiled
        (signature,) = compiled.nopython_signatures
        result = compiled.get_compile_result(signature)
        self.address = int(result.library.get_pointer_to_function(result.fndesc.llvm_cfunc_wrapper_name))

    def __call__(self, *args: Any) -> None:
        """Call it from Python."""
        self.__wrapped__(*args)


def _at_address(_context: Any, address: Any) -> Any:
    def generate(context: Any, builder: Any, _signature: Any, given: Any) -> Any:
        function = cgutils.create_struct_proxy(FUNCTION)(context, builder)
        function.c_addr = builder.inttoptr(given[0], cgutils.voidptr_t)
        return function._getvalue()

    return FUNCTION(address), generate


function_at: Final[Any] = intrinsic(_at_address)
"""The function of a model at an address, for machine code."""


def built(source: str, calls: Mapping[str, str] | None = None) -> Code:
    """The compiled `compute` of some source, which may call others, whose sources were built before."""
    return _built(_text(source, calls or {}))


def _text(source: str, calls: Mapping[str, str]) -> str:
    called, imports = [helper for helper in HELPERS if f"{helper}(" in source], ""
    if called:  # the hash of their file: code that was compiled with another one is not found
        file = Path(__file__).with_name("layers.py")
        imports = f"from ballfg.dynamics.compiled.layers import {', '.join(called)}  # {digest(file)}\n"
    others = (f"from {_name(_text(other, {}))} import compute as {name}\n" for name, other in calls.items())
    makes_arrays = "np." in source
    return HEADER.format(imports=imports + "".join(others), makes_arrays=makes_arrays) + source


def _name(text: str) -> str:
    """The module of a generated file."""
    return f"ballfg_compiled_{hashlib.sha256(text.encode()).hexdigest()[:20]}"


@cache
def _built(text: str) -> Code:
    name = _name(text)
    found = [path for path in readable(f"{name}.py") if _holds(path, text)]
    path = found[0] if found else keep(f"{name}.py", text)
    module = sys.modules[name] = ModuleType(name)  # Python's own cache, if damaged, would be an error at each start
    tree, loops = lowered(ast.parse(text))
    module.__dict__.update(loops)
    exec(compile(tree, path, "exec", dont_inherit=True), module.__dict__)
    module.compute._compile_for_args()
    return Code(module.compute)


def _holds(path: Path, text: str) -> bool:
    """True if a file has exactly this content."""
    try:
        return path.read_bytes() == text.encode()
    except OSError:
        return False


@cache
def digest(file: Path) -> str:
    """Hash of a file's content."""
    return hashlib.sha256(file.read_bytes()).hexdigest()[:12]


def write_note(about: str, note: Mapping[str, Any]) -> None:
    """Keep a note on disk for other processes; a full disk costs them the time to find it out themselves."""
    with suppress(OSError):
        keep(_note_name(about), json.dumps({"note": note, "digest": _digest_of(note)}))


def read_note(about: str) -> Any | None:
    """A note that was kept; None where there is none, or a damaged one."""
    return next((note for note in map(_note_of, readable(_note_name(about))) if note is not None), None)


def _note_of(path: Path) -> Any | None:
    try:
        kept = read_json(path)
    except (OSError, ValueError):
        return None
    whole = isinstance(kept, dict) and "note" in kept and kept.get("digest") == _digest_of(kept["note"])
    return kept["note"] if whole else None


def _digest_of(note: Any) -> str:
    return hashlib.sha256(json.dumps(note).encode()).hexdigest()


def _note_name(about: str) -> str:
    return f"{hashlib.sha256(about.encode()).hexdigest()[:20]}.json"
