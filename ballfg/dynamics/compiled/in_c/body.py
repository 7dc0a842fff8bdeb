"""Collects the lines of a C function while a Python function is translated."""

import re
import textwrap
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

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
    kind_of,
    leaves,
    text_of,
)

if TYPE_CHECKING:
    from ballfg.dynamics.compiled.in_c.routines import Routine, Translator

SMALL: Final = 9  # Largest number of entries of an array that begins with zeros
WRAPPED: Final[Mapping[str, Any]] = {"break_long_words": False, "break_on_hyphens": False, "drop_whitespace": True}
TANGENTS: Final = 3  # Place of an array of tangents among the arguments of a function of a model
WIDTH: Final = "d"  # Name of their number there
TIGHT: Final = re.compile(r" ([-=+*/]) (?!-)")  # A space on both sides that C does not need
CONSTANT: Final = re.compile(r" *const \w+ (\w+) = (?!.*\w_\w+\().*;")
"""A line that declares one without a call of another function of the text, which may have effects."""


class Body:
    """The lines of a C function while it is translated.

    Attributes:
        translator: of the whole text.  routine: that is translated.  names: values of its names.  lines: so far.
        written: roots of arrays that are written to.
    """

    def __init__(self, translator: "Translator", routine: "Routine", outer: "Body | None" = None) -> None:
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
        width = given[TANGENTS].shape[2] if routine.generated else None
        if width == 0:  # nobody reads or writes tangents then, those of the coefficients neither
            x, c, w, *_, y, _ = given
            none = [replace(v, shape=(*v.shape, 1), pointer="0", root="", fixed=False) for v in (x, c, y)]
            given = [x, c, w, *none[:2], y, none[2]]
        passed = [leaf for value in given for leaf in leaves(value)]
        if routine.name in BY_HAND:
            passed = [*given, *(Constant(one.size) for one in given[-1:] if isinstance(one, Array))]
        if width is not None:
            passed.append(Constant(width))
            given = [replace(v, shape=(*v.shape[:2], WIDTH)) if len(v.shape) > 2 else v for v in given]
        made = self.translator.made(routine, given)
        for one, written in zip(passed, made.written, strict=False):
            if written and isinstance(one, Array):
                self.written.add(one.root)
        asked = [*made.passed, *[True] * (len(passed) - len(made.passed))]
        passed = [one for one, is_asked in zip(passed, asked, strict=True) if is_asked]
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

    def _inlined(self, routine: "Routine", given: Sequence[Value]) -> Value:
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
        joined = _joined(_used([*lines, *texts.split("\n")]))
        if self.routine.generated:  # its long chains of steps are read by nobody, and their spaces are 5 kB
            joined = [TIGHT.sub(r"\1", line) if line.lstrip().startswith("const double ") else line for line in joined]
        return [part for line in joined for part in textwrap.wrap(line, 118, **WRAPPED) or [""]]


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
    return joined


def leaves_block(value: Value) -> bool:
    """True if a value is an array, or holds one, whose storage may end with its block."""
    return isinstance(value, Array) or (isinstance(value, tuple) and any(map(leaves_block, value)))
