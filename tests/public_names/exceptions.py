"""Exceptions that a function raises itself or through a private helper, against those that its docstring names."""

from __future__ import annotations

import ast
import builtins
import re
from collections.abc import Iterator

from tests.public_names.docstring import AS_ELSEWHERE, Text
from tests.public_names.source import DEFINITION, Source, definition, methods

NOT_ANNOUNCED = {"NotImplementedError", "AssertionError", "StopIteration", "AttributeError", "KeyboardInterrupt"}
"""Exceptions that a docstring need not name: they tell of an error of the programmer, or are part of a protocol."""


def raised(body: ast.AST, caught: frozenset[str] = frozenset()) -> Iterator[str]:
    """Names of the exceptions that a body raises and does not catch."""
    if isinstance(body, ast.Try):
        handled = {
            n.id for h in body.handlers if h.type is not None for n in ast.walk(h.type) if isinstance(n, ast.Name)
        }
        for statement in body.body:
            yield from raised(statement, caught | handled)
        for part in [*body.handlers, *body.orelse, *body.finalbody]:
            yield from raised(part, caught)
        return
    if isinstance(body, ast.Raise) and body.exc is not None:
        thrown = body.exc.func if isinstance(body.exc, ast.Call) else body.exc
        name = ast.unparse(thrown).rpartition(".")[2]
        if name[:1].isupper() and name not in caught | NOT_ANNOUNCED:
            yield name
    for child in ast.iter_child_nodes(body):
        yield from raised(child, caught)


def helpers(node: ast.AST, source: Source, owner: ast.ClassDef | None) -> Iterator[ast.AST]:
    """The private functions and methods of the same module that a function calls."""
    for call in ast.walk(node):
        if not isinstance(call, ast.Call):
            continue
        if isinstance(call.func, ast.Name) and call.func.id.startswith("_"):
            found = definition(source, call.func.id)
            if isinstance(found, DEFINITION):
                yield found
        own = isinstance(call.func, ast.Attribute) and isinstance(call.func.value, ast.Name)
        if own and owner is not None and call.func.value.id in ("self", "cls") and call.func.attr.startswith("_"):
            yield from (m for m in methods(owner) if m.name == call.func.attr)


def unannounced(nodes: list[ast.AST], source: Source, owner: ast.ClassDef | None, texts: list[Text]) -> list[str]:
    """Exceptions that functions, or their helpers, raise and no docstring names under `Raises:`."""
    said = " ".join(text.sections.get("Raises", "") for text in texts)
    found = {name for node in nodes for name in raised(node)}
    if AS_ELSEWHERE.search(said):
        return []
    found |= {name for node in nodes for helper in helpers(node, source, owner) for name in raised(helper)}
    return [
        f"Raises: does not name {name}"
        for name in sorted(found)
        if not any(re.search(rf"\b{family}\b", said) for family in families(name, source))
    ]


def families(name: str, source: Source) -> list[str]:
    """An exception's own name and those of its bases that say more than `Exception`."""
    error = getattr(source.module, name, None) or getattr(builtins, name, None)
    if not (isinstance(error, type) and issubclass(error, BaseException)):
        return [name]
    return [name, *(base.__name__ for base in error.__mro__ if base not in (Exception, BaseException, object))]
