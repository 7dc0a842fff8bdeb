"""A scalar program is straight-line arithmetic that was traced from a model, with symbolic derivatives.

A program is a list of operations on numbers, each used as often as it is needed and computed once. Derivatives are
programs too: the chain rule adds their operations, and terms that are zero or one never become operations.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

Number = int  # The place of a scalar in its program

COMMUTATIVE: Final = frozenset({"add", "mul", "minimum", "maximum"})
FOLDED: Final[dict[str, Callable[..., float]]] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "neg": lambda a: -a,
    "sqrt": math.sqrt,
    "exp": math.exp,
    "abs": abs,
    "minimum": min,
    "maximum": max,
    "tan": math.tan,
}
"""Operations that are evaluated at once if all operands are constants."""


@dataclass(frozen=True)
class Operation:
    """One operation."""

    name: str  # what it does
    operands: tuple[Number, ...] = ()  # the numbers it takes
    constant: float | None = None  # a number of the operation itself, such as an exponent or a value
    where: tuple[int, ...] = ()
    """For a number read from an array or its derivatives: the array, the place in it, the number of operands by which
    derivatives are taken (0: they run backward, to each operand), and the operand."""


@dataclass
class Program:
    """Operations in an order in which each follows its operands."""

    operations: list[Operation] = field(default_factory=list)
    _known: dict[Operation, Number] = field(default_factory=dict)
    _derivatives: dict[tuple[Number, Number], Number] = field(default_factory=dict)

    def input(self) -> Number:
        """A further input."""
        return self.place(Operation("input", constant=float(len(self.operations))))

    def constant(self, value: float) -> Number:
        """A constant."""
        return self.place(Operation("constant", constant=float(value)))

    def value(self, number: Number) -> float | None:
        """The value of a constant; None for another operation."""
        operation = self.operations[number]
        return operation.constant if operation.name == "constant" else None

    def apply(self, name: str, *operands: Number, constant: float | None = None) -> Number:
        """The result of an operation, simplified if an operand is zero or one, or if all are constants."""
        values = [self.value(operand) for operand in operands]
        known = [value for value in values if value is not None]
        if name in FOLDED and len(known) == len(values):
            return self.constant(FOLDED[name](*known))
        simple = self._simplified(name, operands, values)
        if simple is not None:
            return simple
        if name in COMMUTATIVE:
            operands = tuple(sorted(operands))
        return self.place(Operation(name, operands, constant))

    def total(self, terms: Iterable[Number]) -> Number:
        """The sum of numbers."""
        result = self.constant(0.0)
        for term in terms:
            result = self.apply("add", result, term)
        return result

    def place(self, operation: Operation) -> Number:
        """The place of an operation, which is listed only once."""
        if operation not in self._known:
            self._known[operation] = len(self.operations)
            self.operations.append(operation)
        return self._known[operation]

    def _simplified(self, name: str, operands: Sequence[Number], values: Sequence[float | None]) -> Number | None:
        if name == "add" and 0.0 in values:
            return operands[1] if values[0] == 0.0 else operands[0]
        if name == "sub" and values[1] == 0.0:
            return operands[0]
        if name == "sub" and values[0] == 0.0:
            return self.apply("neg", operands[1])
        if name == "mul" and 0.0 in values:
            return self.constant(0.0)
        if name == "mul" and 1.0 in values:
            return operands[1] if values[0] == 1.0 else operands[0]
        if name == "mul" and -1.0 in values:
            return self.apply("neg", operands[1] if values[0] == -1.0 else operands[0])
        if name == "div" and values[0] == 0.0:
            return self.constant(0.0)
        if name == "div" and values[1] == 1.0:
            return operands[0]
        if name == "neg" and self.operations[operands[0]].name == "neg":
            return self.operations[operands[0]].operands[0]
        if name == "where" and operands[1] == operands[2]:
            return operands[1]
        return None

    def derivative(self, number: Number, by: Number) -> Number:
        """The derivative of a number by an input."""
        wanted, place = [number], (number, by)
        while wanted:  # no recursion: programs are thousands of operations deep
            current = wanted[-1]
            if (current, by) in self._derivatives:
                wanted.pop()
                continue
            operation = self.operations[current]
            missing = [o for o in operation.operands if (o, by) not in self._derivatives]
            if missing:
                wanted += missing
                continue
            self._derivatives[current, by] = self._by_chain_rule(current, by)
            wanted.pop()
        return self._derivatives[place]

    def _by_chain_rule(self, number: Number, by: Number) -> Number:
        operation = self.operations[number]
        if number == by:
            return self.constant(1.0)
        moved = [self._derivatives[o, by] for o in operation.operands]
        if all(self.value(m) == 0.0 for m in moved):
            return self.constant(0.0)
        terms = []
        for place, tangent in enumerate(moved):
            if self.value(tangent) != 0.0:
                rule = PARTIALS.get(operation.name)
                if rule is None:
                    raise NotImplementedError(f"'{operation.name}' has no derivative")
                terms.append(self.apply("mul", rule(self, number, operation, place), tangent))
        return self.total(terms)

    def needed(self, outputs: Iterable[Number]) -> list[Number]:
        """The numbers on which outputs depend, in their order."""
        found: set[Number] = set()
        wanted = list(outputs)
        while wanted:
            number = wanted.pop()
            if number not in found:
                found.add(number)
                wanted += self.operations[number].operands
        return sorted(found)


Partial = Callable[[Program, Number, Operation, int], Number]
"""From a program, the number of a result, its operation and the place of an operand to a derivative."""


def _chosen(comparison: str) -> Partial:
    """The derivative of a minimum or maximum: one for the selected operand."""

    def partial(p: Program, _: Number, operation: Operation, place: int) -> Number:
        taken = p.apply(comparison, operation.operands[place], operation.operands[1 - place])
        return p.apply("where", taken, p.constant(1.0), p.constant(0.0))

    return partial


def _of_where(p: Program, _: Number, operation: Operation, place: int) -> Number:
    if place == 0:
        return p.constant(0.0)
    return p.apply("where", operation.operands[0], p.constant(float(place == 1)), p.constant(float(place == 2)))


def _of_div(p: Program, number: Number, operation: Operation, place: int) -> Number:
    below = operation.operands[1]
    return p.apply("div", p.constant(1.0), below) if place == 0 else p.apply("neg", p.apply("div", number, below))


def _of_pow(p: Program, _: Number, operation: Operation, __: int) -> Number:
    exponent = float(operation.constant or 0.0)
    lower = p.apply("pow", operation.operands[0], constant=exponent - 1.0)
    return p.apply("mul", p.constant(exponent), lower)


def _of_read(p: Program, number: Number, operation: Operation, place: int) -> Number:
    """The derivative by one of the numbers through which an array depends on others; zero by all other numbers."""
    block, entry, through = operation.where
    if not through:
        return p.place(Operation("back", (number, operation.operands[place]), where=(block, entry)))
    if place >= through:
        return p.constant(0.0)
    by, loaded = operation.operands[:through], operation.operands[through:]
    moved = [p.derivative(one, other) for one in loaded for other in by]
    return p.place(Operation("slope", (number, *by, *moved), where=(block, entry, through, place)))


PARTIALS: Final[dict[str, Partial]] = {
    "add": lambda p, n, o, k: p.constant(1.0),
    "sub": lambda p, n, o, k: p.constant(1.0 if k == 0 else -1.0),
    "neg": lambda p, n, o, k: p.constant(-1.0),
    "mul": lambda p, n, o, k: o.operands[1 - k],
    "div": _of_div,
    "sqrt": lambda p, n, o, k: p.apply("halved_inverse", n),  # zero at zero, as autograd has it of a length
    "exp": lambda p, n, o, k: n,
    "log": lambda p, n, o, k: p.apply("div", p.constant(1.0), o.operands[0]),
    "sin": lambda p, n, o, k: p.apply("cos", o.operands[0]),
    "cos": lambda p, n, o, k: p.apply("neg", p.apply("sin", o.operands[0])),
    "tan": lambda p, n, o, k: p.apply("add", p.constant(1.0), p.apply("mul", n, n)),
    "tanh": lambda p, n, o, k: p.apply("sub", p.constant(1.0), p.apply("mul", n, n)),
    "abs": lambda p, n, o, k: p.apply("sign", o.operands[0]),
    "minimum": _chosen("le"),
    "maximum": _chosen("ge"),
    "where": _of_where,
    "pow": _of_pow,
    "read": _of_read,
    **dict.fromkeys(("le", "ge", "lt", "gt", "sign"), lambda p, *_: p.constant(0.0)),
}
"""Derivatives by operation."""
