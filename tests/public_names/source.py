"""Syntax trees of modules, and the arrays that annotations in them hold."""

from __future__ import annotations

import ast
import importlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType

from tests.public_names.docstring import has_shape, has_unit

ARRAYS = {"ndarray", "NDArray", "ArrayLike", "Tensor"}

DEFINITION = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class Source:
    """A module with its syntax tree."""

    module: ModuleType
    tree: ast.Module

    @property
    def place(self) -> str:
        """The file, from the working directory where it lies below it."""
        path = Path(self.module.__file__ or "")
        return str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)


@cache
def source_of(module: str) -> Source:
    """Source and syntax tree of an imported module."""
    loaded = importlib.import_module(module)
    assert loaded.__file__ is not None
    return Source(loaded, ast.parse(Path(loaded.__file__).read_text(encoding="utf-8")))


def statements(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """The statements of a body, those under `if` too."""
    for statement in body:
        yield statement
        if isinstance(statement, ast.If):
            yield from statements(statement.body + statement.orelse)


def definition(source: Source, name: str) -> ast.stmt | None:
    """The function or class of this name at the top of a module; of an overloaded function, its implementation."""
    for statement in statements(source.tree.body):
        if isinstance(statement, DEFINITION | ast.ClassDef) and statement.name == name and not _overload(statement):
            return statement
    return None


def _overload(node: DEFINITION | ast.ClassDef) -> bool:
    return any(isinstance(mark, ast.Name) and mark.id == "overload" for mark in node.decorator_list)


def methods(node: ast.ClassDef) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    """The methods in a class's own body."""
    yield from (s for s in statements(node.body) if isinstance(s, DEFINITION) and not _overload(s))


def parsed(annotation: ast.expr | None) -> ast.expr | None:
    """An annotation as an expression, also where it is written as a string."""
    if isinstance(annotation, ast.Constant) and isinstance(annotation.value, str):
        return ast.parse(annotation.value, mode="eval").body
    return annotation


def alias(source: Source, name: str) -> tuple[Source, ast.expr, str | None] | None:
    """What a module's name for a type stands for, with the docstring below it."""
    body = list(statements(source.tree.body))
    for i, statement in enumerate(body):
        value: ast.expr | None = None
        if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name):
            value = statement.value if statement.targets[0].id == name else None
        elif isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            value = statement.value if statement.target.id == name else None
        elif isinstance(statement, ast.ImportFrom) and (statement.module or "").startswith("ballfg"):
            for imported in statement.names:
                if (imported.asname or imported.name) == name:
                    return alias(defining(statement.module or "", imported.name), imported.name)
        if value is not None:
            return source, value, docstring_at(body, i + 1)
    return None


def defining(module: str, name: str) -> Source:
    """The module where a name that a room hands out is defined, as far as its object tells."""
    found = getattr(importlib.import_module(module), name, None)
    owner = getattr(found, "__module__", None)
    return source_of(owner if isinstance(owner, str) and owner.startswith("ballfg") else module)


def docstring_at(body: list[ast.stmt], index: int) -> str | None:
    """The string that stands by itself at a place of a body."""
    if index < len(body):
        statement = body[index]
        if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
            return statement.value.value if isinstance(statement.value.value, str) else None
    return None


@dataclass(frozen=True)
class Arrays:
    """What arrays an annotation holds."""

    count: int = 0
    told: bool = False
    """Shape and unit stand at the alias of the type."""
    boolean: bool = False


def arrays_in(annotation: ast.expr | None, source: Source) -> Arrays:
    """Counts the arrays of an annotation; functions that take or give arrays are none."""
    node = parsed(annotation)
    if node is None:
        return Arrays()
    if isinstance(node, ast.Name | ast.Attribute):
        name = node.id if isinstance(node, ast.Name) else node.attr
        if name in ARRAYS:
            return Arrays(1)
        found = alias(source, name) if isinstance(node, ast.Name) else None
        if found is None:
            return Arrays()
        inside = arrays_in(found[1], found[0])
        told = found[2] is not None and has_shape(found[2]) and has_unit(found[2])
        return Arrays(inside.count, told, inside.boolean)
    if isinstance(node, ast.Subscript):
        base = ast.unparse(node.value).rpartition(".")[2]
        if base in ("Callable", "Literal", "type"):
            return Arrays()
        if base in ARRAYS:
            return Arrays(1, boolean="bool" in ast.unparse(node.slice))
        return arrays_in(node.slice, source)
    if isinstance(node, ast.BinOp):
        both = [arrays_in(side, source) for side in (node.left, node.right)]
        return max(both, key=lambda found: found.count)
    if isinstance(node, ast.Tuple | ast.List):
        each = [arrays_in(element, source) for element in node.elts]
        holding = [found for found in each if found.count]
        return Arrays(
            sum(found.count for found in each),
            bool(holding) and all(found.told for found in holding),
            bool(holding) and all(found.boolean for found in holding),
        )
    return Arrays()
