"""Translates Python functions to C functions, one for each form of the arguments with which they are called."""

import ast
import inspect
import re
import textwrap
from collections import Counter
from collections.abc import Callable, Hashable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from typing import Any, Self

from ballfg.dynamics.compiled.in_c.body import WIDTH, Body
from ballfg.dynamics.compiled.in_c.helpers import BY_HAND
from ballfg.dynamics.compiled.in_c.statements import block
from ballfg.dynamics.compiled.in_c.values import Array, UntranslatableError, Value, form

Blocks = tuple[int, ...]  # The blocks around a place in a function


@dataclass(frozen=True, eq=False)
class Routine:
    """A Python function as syntax."""

    name: str  # in C
    tree: ast.FunctionDef  # of the function
    known: Mapping[str, Any]  # the names of its module
    changing: Set[str]  # names of numbers that are variables
    generated: bool = False  # true for a function of a model: one in C serves any number of tangents

    @classmethod
    def of(cls, function: Callable[..., Any]) -> Self:
        """Of a function with a file."""
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(function))).body
        assert isinstance(tree, ast.FunctionDef)
        return cls(function.__name__.strip("_"), tree, function.__globals__, _changing(tree))

    @classmethod
    def of_source(cls, name: str, source: str, known: Mapping[str, Any], *, calls: bool = False) -> Self:
        """Of the one function in a generated text, which computes a number anew in each loop that needs it.

        Args: known: the names of its module.  calls: it does nothing but call others, with arrays of its own.
        """
        (tree,) = ast.parse(source).body
        assert isinstance(tree, ast.FunctionDef)
        return cls(name, tree, known, frozenset(), generated=not calls)

    def returns(self) -> list[ast.Return]:
        """Its statements that return a value."""
        return [node for node in ast.walk(self.tree) if isinstance(node, ast.Return) and node.value is not None]

    def is_inlined(self) -> bool:
        """True if it ends in its only result, a tuple or a call: it may give arrays of its own."""
        found = self.returns()
        return len(found) == 1 and found[0] is self.tree.body[-1] and isinstance(found[0].value, ast.Tuple | ast.Call)


def _changing(tree: ast.FunctionDef) -> set[str]:
    """Names that are given values in more than one place, arguments that are given one, and names read beyond a block.

    A block is the body of a loop or of a condition: what C declares in it is gone after it.
    """
    stores: list[tuple[str, Blocks]] = [(a.arg, ()) for a in tree.args.args]
    loads = list[tuple[str, Blocks]]()
    counters: set[str] = set()

    def visit(node: ast.AST, blocks: Blocks) -> None:
        if isinstance(node, ast.Name):
            (loads if isinstance(node.ctx, ast.Load) else stores).append((node.id, blocks))
        if isinstance(node, ast.AugAssign) and isinstance(node.target, ast.Name):
            stores.append((node.target.id, blocks))
        for name, value in ast.iter_fields(node):
            inner = (*blocks, id(value)) if name in ("body", "orelse") and node is not tree else blocks
            for part in value if isinstance(value, list) else [value]:
                if isinstance(node, ast.For) and part is node.target and isinstance(part, ast.Name):
                    counters.add(part.id)
                elif isinstance(part, ast.AST):
                    visit(part, inner)

    visit(tree, ())
    places = Counter(name for name, _ in stores)
    first = dict(reversed(stores))
    beyond = {name for name, blocks in loads if name in first and blocks[: len(first[name])] != first[name]}
    return ({name for name, count in places.items() if count > 1} | beyond) - counters


@dataclass(frozen=True)
class Made:
    """A C function.

    Attributes: name: of it.  kind: of its result; None: none.  outputs: kinds of results that go to pointers.
        written: whether each of the arguments is written to.  passed: whether C gets it; those that nothing reads are
            left out.
    """

    name: str
    kind: str | None
    outputs: Sequence[str]
    written: Sequence[bool]
    passed: Sequence[bool]


@dataclass
class Translator:
    """The C functions that were asked for and all those that they call."""

    prefix: str  # of their names
    texts: list[str] = field(default_factory=list)  # in an order in which each comes after what it calls
    _made: dict[tuple[Hashable, ...], Made] = field(default_factory=dict)
    _texts: dict[tuple[Hashable, ...], str] = field(default_factory=dict)  # names of the functions, by their texts
    _routines: dict[Any, Routine] = field(default_factory=dict)
    _names: Counter[str] = field(default_factory=Counter)

    def routine(self, function: Any) -> Routine:
        """The syntax of a function of Python or of numba."""
        if isinstance(function, Routine):
            return function
        plain = getattr(function, "py_func", function)
        if not inspect.isfunction(plain):
            raise UntranslatableError(f"{function!r} has no translation to C")
        if plain not in self._routines:
            self._routines[plain] = Routine.of(plain)
        return self._routines[plain]

    def made(self, routine: Routine, given: Sequence[Value], bound: Mapping[str, Value] | None = None) -> Made:
        """The C function for arguments of a form. Args: bound: arguments that it finds among the tables instead."""
        key = (routine, *map(form, given))
        if key not in self._made:
            by_hand = routine.name in BY_HAND
            self._made[key] = self._by_hand(routine) if by_hand else self._translated(routine, given, bound or {})
        return self._made[key]

    def _by_hand(self, routine: Routine) -> Made:
        name, (text, written) = f"{self.prefix}_{routine.name}", BY_HAND[routine.name]
        if not self._names[routine.name]:
            self._names[routine.name] += 1
            self.texts.append(text.replace("NAME", name))
        return Made(name, None, (), written, [True] * len(written))

    def _translated(self, routine: Routine, given: Sequence[Value], bound: Mapping[str, Value]) -> Made:
        body = Body(self, routine)
        body.names.update(bound)
        arguments = body.take(given)
        block(body, routine.tree.body)
        if not body.lines:
            return Made("", None, (), [False] * len(arguments), [False] * len(arguments))
        kind, outputs = body.result()
        lines = body.finished()
        words = set(re.findall(r"\w+", "\n".join(lines)))
        names = [a.pointer if isinstance(a, Array) else a.text for a in arguments]
        passed = [bool(bound) or name in words for name in names]  # whoever calls from outside gives all
        given_to_c = [
            f"{'' if a.root in body.written else 'const '}double *{name}"
            if isinstance(a, Array)
            else f"{a.kind} {name}"
            for a, name, is_passed in zip(arguments, names, passed, strict=True)
            if is_passed
        ]
        given_to_c += [f"int {WIDTH}" for _ in arguments[:1] if routine.generated]
        given_to_c += [f"{one} *out{k}" for k, one in enumerate(outputs)]
        unread = [f" (void){name};" for name in names if bound and name not in words]
        text = f"({', '.join(given_to_c) or 'void'}) {{", *unread, *lines, "}"
        name = self._named(routine, kind or "void", text)
        return Made(name, kind, outputs, [isinstance(a, Array) and a.root in body.written for a in arguments], passed)

    def _named(self, routine: Routine, kind: str, text: Sequence[str]) -> str:
        """The name of the function with a text after its name: that of an earlier one with the same text, if any."""
        key = (routine, kind, *text)
        if key not in self._texts:
            self._names[routine.name] += 1
            number = self._names[routine.name]
            self._texts[key] = f"{self.prefix}_{routine.name}" + (f"_{number}" if number > 1 else "")
            told = (ast.get_docstring(routine.tree) or f"The {routine.name} of the model.").splitlines()[0]
            above = [f"/* {told} */"] if number == 1 else []
            self.texts.append("\n".join([*above, f"static inline {kind} {self._texts[key]}{text[0]}", *text[1:]]))
        return self._texts[key]
