"""Translates Python functions to C functions, one for each form of the arguments with which they are called."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Final

from ballfg.dynamics.compiled.in_c.helpers import BY_HAND
from ballfg.dynamics.compiled.in_c.statements import block
from ballfg.dynamics.compiled.in_c.values import (
    DOUBLE,
    INT,
    Array,
    Constant,
    Scalar,
    UntranslatableError,
    Value,
    common,
    form,
    kind_of,
    leaves,
    text_of,
)

SMALL: Final = 9
"""Largest number of entries of an array that begins with zeros."""
WRAPPED: Final[Mapping[str, Any]] = {"break_long_words": False, "break_on_hyphens": False, "drop_whitespace": True}
TANGENTS: Final = 3
"""Place of an array of tangents among the arguments of a function of a model."""
WIDTH: Final = "d"
"""Name of their number there."""
CONSTANT: Final = re.compile(r" *const \w+ (\w+) = (?!.*\w_\w+\().*;")
"""A line that declares one without a call of another function of the text, which may have effects."""
Blocks = tuple[int, ...]
"""The blocks around a place in a function."""


@dataclass(frozen=True, eq=False)
class Routine:
    """A Python function as syntax.

    Attributes:
        name: in C.  tree: of the function.  known: the names of its module.
        changing: names of numbers that are variables.
        generated: true for a function of a model: one in C serves any number of tangents.
    """

    name: str
    tree: ast.FunctionDef
    known: Mapping[str, Any]
    changing: Set[str]
    generated: bool = False

    @classmethod
    def of(cls, function: Callable[..., Any]) -> Routine:
        """Of a function with a file."""
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(function))).body
        assert isinstance(tree, ast.FunctionDef)
        return cls(function.__name__.strip("_"), tree, function.__globals__, _changing(tree))

    @classmethod
    def of_source(cls, name: str, source: str, known: Mapping[str, Any]) -> Routine:
        """Of the one function in a generated text, which computes a number anew in each loop that needs it."""
        (tree,) = ast.parse(source).body
        assert isinstance(tree, ast.FunctionDef)
        return cls(name, tree, known, frozenset(), generated=True)

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
        written: whether each of the arguments that C gets is written to.
    """

    name: str
    kind: str | None
    outputs: Sequence[str]
    written: Sequence[bool]


@dataclass
class Translator:
    """The C functions that were asked for and all those that they call.

    Attributes: prefix: of their names.  texts: in an order in which each comes after what it calls.
    """

    prefix: str
    texts: list[str] = field(default_factory=list)
    _made: dict[tuple[Hashable, ...], Made] = field(default_factory=dict)
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
        return Made(name, None, (), written)

    def _translated(self, routine: Routine, given: Sequence[Value], bound: Mapping[str, Value]) -> Made:
        body = Body(self, routine)
        body.names.update(bound)
        arguments = body.take(given)
        block(body, routine.tree.body)
        if not body.lines:
            return Made("", None, (), [False] * len(arguments))
        self._names[routine.name] += 1
        number = self._names[routine.name]
        name = f"{self.prefix}_{routine.name}" + (f"_{number}" if number > 1 else "")
        kind, outputs = body.result()
        passed = [
            f"{'' if a.root in body.written else 'const '}double *{a.pointer}"
            if isinstance(a, Array)
            else f"{a.kind} {a.text}"
            for a in arguments
        ]
        passed += [f"int {WIDTH}" for a in arguments[:1] if routine.generated and not given[TANGENTS].empty]
        passed += [f"{one} *out{k}" for k, one in enumerate(outputs)]
        told = (ast.get_docstring(routine.tree) or f"The {routine.name} of the model.").splitlines()[0]
        head = f"static inline {kind or 'void'} {name}({', '.join(passed) or 'void'}) {{"
        lines = body.finished()
        words = set(re.findall(r"\w+", "\n".join(lines)))
        unused = [leaf for leaf in map(_name, arguments) if leaf not in words]
        above = [f"/* {told} */"] if number == 1 else []
        self.texts.append("\n".join([*above, head, *(f" (void){leaf};" for leaf in unused), *lines, "}"]))
        return Made(name, kind, outputs, [isinstance(a, Array) and a.root in body.written for a in arguments])


class Body:
    """The lines of a C function while it is translated.

    Attributes:
        translator: of the whole text.  routine: that is translated.  names: values of its names.  lines: so far.
        written: roots of arrays that are written to.
    """

    def __init__(self, translator: Translator, routine: Routine, outer: Body | None = None) -> None:
        self.translator, self.routine, self.names = translator, routine, dict[str, Value]()
        self._outer = outer
        self.lines: list[str] = [] if outer is None else outer.lines
        self.written: set[str] = set() if outer is None else outer.written
        self._used: Counter[str] = Counter() if outer is None else outer._used
        self._depth: list[int] = [1] if outer is None else outer._depth
        self._declared: dict[str, str] = {} if outer is None else outer._declared
        self._kept: set[str] = set() if outer is None else outer._kept
        self._returned: list[Value] = []
        self._texts: dict[str, str] = {}

    def line(self, text: str) -> None:
        """Write a line."""
        self.lines.append(" " * self._depth[0] + text)

    @contextmanager
    def indented(self) -> Iterator[None]:
        """Lines of an inner block: what is named there is gone after it, but for numbers that change."""
        before, used = dict(self.names), Counter(self._used)
        self._depth[0] += 1
        yield
        self._depth[0] -= 1
        self._used.clear()
        self._used.update(used | Counter(dict.fromkeys(self._declared, 1)))  # others may be named so again
        if moved := [name for name, value in before.items() if leaves_block(value) and self.names[name] is not value]:
            raise UntranslatableError(f"{moved[0]} of {self.routine.name} becomes another array within a block")
        kept = {n: v for n, v in self.names.items() if isinstance(v, Scalar) and v.text in self._declared}
        self.names = {**kept, **before}

    def fresh(self, name: str) -> str:
        """A name in C that nothing else has."""
        self._used[name] += 1
        number = self._used[name]
        return name if number == 1 else self.fresh(f"{name}_{number}")

    def take(self, given: Sequence[Value]) -> list[Any]:
        """Name the arguments of a C function; returns those that C passes."""
        arguments = [a.arg for a in self.routine.tree.args.args if a.arg not in self.names]
        named = [self._argument(name, value) for name, value in zip(arguments, given, strict=True)]
        for name, value in zip(arguments, named, strict=True):
            self.names[name] = value
        return [leaf for value in named for leaf in leaves(value)]

    def _argument(self, name: str, value: Value) -> Value:
        if isinstance(value, tuple):
            fields = getattr(value, "_fields", range(len(value)))
            named = [str(p) if isinstance(one, tuple) else f"{name}_{p}" for p, one in zip(fields, value, strict=True)]
            parts = [self._argument(part, one) for part, one in zip(named, value, strict=True)]
            return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
        if leaves(value) and not isinstance(value, Array):
            return Scalar(self.fresh(name), kind_of(value))
        if isinstance(value, Array) and leaves(value):
            pointer = self.fresh(name)
            return Array(pointer, value.shape, pointer)
        return value

    def name(self, name: str, value: Value) -> None:
        """Give a name a value. A number becomes a variable, unless it is given once."""
        changes = name in self.routine.changing
        if name == "_" or not (isinstance(value, Scalar) or (isinstance(value, Constant) and changes)):
            self.names[name] = value
            return
        if isinstance(value, Scalar) and not changes:
            again = self.routine.generated and name in self.names and self._texts.get(name) == value.text
            if not again:  # generated code computes a number anew in each of its loops
                self.names[name], self._texts[name] = self.kept(value, name), value.text
            return
        before = self.names.get(name)
        if isinstance(before, Scalar):
            known = before
        else:
            known = Scalar(self.fresh(name), kind_of(value))
            self._declared[known.text], self.names[name] = known.kind, known
        if known.kind == INT and kind_of(value) == DOUBLE:
            raise UntranslatableError(f"{name} of {self.routine.name} holds whole numbers first, and then others")
        self.line(f"{known.text} = {text_of(value)};")

    def kept(self, value: Value, name: str = "t") -> Value:
        """A number that may be read several times, and does not change with the variables it is made of."""
        if not isinstance(value, Scalar) or value.text in self._kept:
            return value
        kept = Scalar(self.fresh(name), value.kind)
        self._kept.add(kept.text)
        self.line(f"const {kept.kind} {kept.text} = {value.text};")
        return kept

    def pointed(self, array: Array) -> Array:
        """An array by a pointer of its own, which does not move with the variables that told its place."""
        if array.empty:
            return array
        name = self.fresh("p")
        self.line(f"<{array.root}>double *const {name} = {array.pointer};")
        return replace(array, pointer=name)

    def storage(self, shape: Sequence[int | str | None], filled: Value | None) -> Array:
        """A new array. Args: filled: the number in all places; None: none yet."""
        array = Array("", tuple(shape), "")
        if array.empty:
            return array
        name = self.fresh("a")
        zero = isinstance(filled, Constant) and not filled.value
        known = zero or array.size <= SMALL  # compilers warn of small arrays that they take to be without content
        self.line(f"double {name}[{array.size}]{' = {0.0}' if known else ''};")
        made = Array(name, tuple(shape), name)
        self.written.add(name)
        if filled is not None and not zero:
            self.fill(made, filled)
        return made

    def fill(self, into: Array, value: Value) -> None:
        """Write one number to all places of an array."""
        if not into.empty:
            self._each(into, f"{into.pointer}[INDEX] = {text_of(self.kept(value))};")

    def copy(self, into: Array, source: Array, sign: str = "") -> None:
        """Write the numbers of an array to another one of the same size. Args: sign: before each of them."""
        if into.size != source.size:
            raise UntranslatableError(f"{source.pointer} has another size than {into.pointer}")
        if not into.empty:
            self._each(into, f"{into.pointer}[INDEX] = {sign}{source.pointer}[INDEX];")

    def _each(self, into: Array, text: str) -> None:
        index = self.fresh("i")
        self.line(f"for (int {index} = 0; {index} < {into.size}; ++{index}) {text.replace('INDEX', index)}")

    def leave(self, value: Value) -> None:
        """End the function with a result."""
        self._returned.append(value)
        if self._outer is not None:
            return
        if value == ():
            self.line("return;")
        elif isinstance(value, tuple):
            for k, one in enumerate(value):
                self.line(f"*out{k} = {text_of(one)};")
            self.line("return;")
        else:
            self.line(f"return {text_of(value)};")

    def result(self) -> tuple[str | None, list[str]]:
        """Kind of the result, and those of results that go to pointers."""
        values = [value for value in self._returned if value != ()]
        if not values:
            return None, []
        if isinstance(values[0], tuple):
            return None, [common(one) for one in zip(*values, strict=True)]
        return common(values), []

    def call(self, function: Any, given: Sequence[Value]) -> Value:
        """The result of a function: of a C function, or of its lines written here."""
        routine = self.translator.routine(function)
        if routine.is_inlined():
            return self._inlined(routine, given)
        passed = [leaf for value in given for leaf in leaves(value)]
        if routine.name in BY_HAND:
            passed = [*given, *(Constant(one.size) for one in given[-1:] if isinstance(one, Array))]
        if routine.generated and (width := given[TANGENTS].shape[2]):
            passed.append(Constant(width))
            given = [replace(v, shape=(*v.shape[:2], WIDTH)) if len(v.shape) > 2 else v for v in given]
        made = self.translator.made(routine, given)
        for one, written in zip(passed, made.written, strict=False):
            if written and isinstance(one, Array):
                self.written.add(one.root)
        texts = [one.pointer if isinstance(one, Array) else text_of(one) for one in passed]
        if not made.name:  # it does nothing with such arguments
            return ()
        outputs = [Scalar(self.fresh("r"), kind) for kind in made.outputs]
        for output in outputs:
            self.line(f"{output.kind} {output.text};")
        call = f"{made.name}({', '.join([*texts, *(f'&{output.text}' for output in outputs)])})"
        if made.kind is not None:
            return Scalar(call, made.kind)
        self.line(f"{call};")
        return tuple(outputs)

    def _inlined(self, routine: Routine, given: Sequence[Value]) -> Value:
        inner = Body(self.translator, routine, self)
        for argument, value in zip(routine.tree.args.args, given, strict=True):
            inner.names[argument.arg] = inner.kept(value)
        block(inner, routine.tree.body)
        return inner._returned[-1]

    def finished(self) -> list[str]:
        """All lines: the variables first."""
        lines = [f" {kind} {name} = 0;" for name, kind in self._declared.items()]
        roots = {line[line.index("<") + 1 : line.index(">")] for line in self.lines if line.lstrip().startswith("<")}
        texts = "\n".join(self.lines)
        for root in sorted(roots):
            texts = texts.replace(f"<{root}>double *const", f"{'' if root in self.written else 'const '}double *const")
        return _joined(_used([*lines, *texts.split("\n")]))


def _used(lines: list[str]) -> list[str]:
    """The lines without constants that no other line reads."""
    while True:
        words = Counter(re.findall(r"[A-Za-z_]\w*", "\n".join(lines)))
        read = [line for line in lines if not (found := CONSTANT.fullmatch(line)) or words[found[1]] > 1]
        if len(read) == len(lines):
            return read
        lines = read


def _joined(lines: Sequence[str]) -> list[str]:
    """The lines with constants of one type that follow one another in one declaration."""
    joined: list[str] = []
    for line in lines:
        start, declared = re.match(r" *const \w+ ", line), CONSTANT.fullmatch(line)
        if joined and declared and start and joined[-1].startswith(start[0]) and CONSTANT.fullmatch(joined[-1]):
            joined[-1] = f"{joined[-1][:-1]}, {line[start.end() :]}"
        else:
            joined.append(line)
    return [part for line in joined for part in textwrap.wrap(line, 118, **WRAPPED) or [""]]


def _name(argument: Scalar | Array) -> str:
    return argument.pointer if isinstance(argument, Array) else argument.text


def leaves_block(value: Value) -> bool:
    """True if a value is an array, or holds one, whose storage may end with its block."""
    return isinstance(value, Array) or (isinstance(value, tuple) and any(map(leaves_block, value)))
