"""Translates expressions of Python functions to C."""

import ast
import builtins
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ballfg.dynamics.compiled.build import function_at
from ballfg.dynamics.compiled.in_c.values import (
    ANY,
    ATOM,
    DOUBLE,
    INT,
    PLUS,
    TIMES,
    Array,
    Constant,
    Scalar,
    UntranslatableError,
    Value,
    common,
    kind_of,
    lifted,
    text_of,
)

if TYPE_CHECKING:
    from ballfg.dynamics.compiled.in_c.body import Body

BINARY: Final[dict[type[ast.operator], tuple[str, Callable[[Any, Any], Any]]]] = {
    ast.Add: ("+", lambda a, b: a + b),
    ast.Sub: ("-", lambda a, b: a - b),
    ast.Mult: ("*", lambda a, b: a * b),
    ast.Div: ("/", lambda a, b: a / b),
    ast.BitAnd: ("&", lambda a, b: a & b),
    ast.Pow: ("**", lambda a, b: a**b),
}
IDLE: Final = ((ast.Add, Constant(0)), (ast.Mult, Constant(1.0)))
"""Operators and left operands that change nothing, not even the sign of a zero."""
COMPARED: Final[dict[type[ast.cmpop], tuple[str, Callable[[Any, Any], bool]]]] = {
    ast.Eq: ("==", lambda a, b: a == b),
    ast.NotEq: ("!=", lambda a, b: a != b),
    ast.Lt: ("<", lambda a, b: a < b),
    ast.LtE: ("<=", lambda a, b: a <= b),
    ast.Gt: (">", lambda a, b: a > b),
    ast.GtE: (">=", lambda a, b: a >= b),
}
OF_LIBM: Final = {
    **{getattr(math, name): (name, DOUBLE) for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "tanh", "erfc")},
    **{math.isnan: ("isnan", INT), math.isfinite: ("isfinite", INT), abs: ("fabs", DOUBLE)},
    **{math.ceil: ("(int)ceil", INT), math.floor: ("(int)floor", INT)},
}
"""Functions of one number by their names in C."""
OF_TWO: Final = {min: "<", max: ">"}


def constant_of(value: Value) -> int | float:
    """The number of a constant. Raises: UntranslatableError: for anything else."""
    if not isinstance(value, Constant):
        raise UntranslatableError(f"{value!r} must be known when C is written")
    return value.value


def expression(body: "Body", node: ast.expr) -> Value:
    """The value of an expression; what it needs is written before, to the lines of the body."""
    match node:
        case ast.Constant():
            return lifted(node.value)
        case ast.Name():
            return _named(body, node.id)
        case ast.Attribute():
            return _attribute(expression(body, node.value), node.attr)
        case ast.Tuple():
            return tuple(_several(body, node.elts))
        case ast.UnaryOp():
            return _unary(body, node.op, expression(body, node.operand))
        case ast.BinOp():
            return _binary(body, type(node.op), expression(body, node.left), expression(body, node.right))
        case ast.BoolOp():
            return _joined(isinstance(node.op, ast.And), [partial(expression, body, v) for v in node.values])
        case ast.Compare():
            values = [expression(body, part) for part in (node.left, *node.comparators)]
            pairs = zip(node.ops, values, values[1:], strict=False)
            return _joined(True, [partial(_compared, type(o), a, b) for o, a, b in pairs])
        case ast.IfExp():
            return _chosen(body, node)
        case ast.Subscript():
            return _element(body, node)
        case ast.Call():
            return _called(body, node)
    raise UntranslatableError(f"{ast.unparse(node)} has no translation to C")


def _several(body: "Body", nodes: Sequence[ast.expr]) -> list[Value]:
    """Values of arguments, those of a starred tuple among them."""
    found: list[Value] = []
    for node in nodes:
        starred = isinstance(node, ast.Starred)
        value = expression(body, node.value if isinstance(node, ast.Starred) else node)
        found += value if starred else [value]
    return found


def _named(body: "Body", name: str) -> Value:
    if name in body.names:
        return body.names[name]
    if name in body.routine.known:
        return lifted(body.routine.known[name])
    if hasattr(builtins, name):
        return getattr(builtins, name)
    raise UntranslatableError(f"{name} is not known where it is used in {body.routine.name}")


def _attribute(owner: Value, name: str) -> Value:
    if isinstance(owner, Array):
        if name == "shape":
            return tuple(Scalar(n, INT) if isinstance(n, str) else lifted(n) for n in owner.shape)
        return owner, name  # a method, for `_called`
    if isinstance(owner, ModuleType | tuple):
        return lifted(getattr(owner, name))
    raise UntranslatableError(f"{owner!r} has no attribute '{name}' in C")


def _unary(body: "Body", operator: ast.unaryop, value: Value) -> Value:
    if isinstance(operator, ast.Not):
        return (
            Constant(not value.value) if isinstance(value, Constant) else Scalar(f"!{text_of(value, ATOM)}", INT, ANY)
        )
    if not isinstance(operator, ast.USub):
        raise UntranslatableError(f"{operator!r} has no translation to C")
    if isinstance(value, Array):
        opposite = body.storage(value.shape, None)
        body.copy(opposite, value, "-")
        return opposite
    return (
        Constant(-value.value)
        if isinstance(value, Constant)
        else Scalar(f"-{text_of(value, ATOM)}", kind_of(value), ANY)
    )


def _binary(body: "Body", operator: type[ast.operator], a: Value, b: Value) -> Value:
    sign, compute = BINARY[operator]
    if isinstance(a, Constant) and isinstance(b, Constant):
        return Constant(compute(a.value, b.value))
    if operator is ast.Pow:
        return _power(body, a, constant_of(b))
    if (operator, a) in IDLE and kind_of(a) == kind_of(b):
        return b
    rank = PLUS if operator in (ast.Add, ast.Sub) else TIMES if operator in (ast.Mult, ast.Div) else ANY
    kind = DOUBLE if operator is ast.Div else common((a, b))
    left = f"(double){text_of(a, ATOM)}" if operator is ast.Div and common((a, b)) == INT else text_of(a, _within(rank))
    return Scalar(f"{left} {sign} {text_of(b, _within(rank) - 1)}", kind, rank)


def _within(rank: int) -> int:
    """The highest rank of a left operand that needs no brackets."""
    return rank if rank in (TIMES, PLUS) else TIMES


def _power(body: "Body", base: Value, exponent: int | float) -> Value:
    if isinstance(exponent, int) and exponent > 0:
        return Scalar(" * ".join([text_of(body.kept(base), ATOM)] * exponent), kind_of(base), TIMES)
    return Scalar(f"pow({text_of(base)}, {text_of(Constant(exponent))})", DOUBLE)


def _joined(every: bool, parts: Sequence[Callable[[], Value]]) -> Value:
    """Truth of all or of any; a constant that decides ends it."""
    values: list[Value] = []
    for part in parts:
        value = part()
        decides = isinstance(value, Constant) and bool(value.value) is not every
        if decides or not isinstance(value, Constant):
            values.append(value)
        if decides:
            break
    if len(values) <= 1:
        return values[0] if values else Constant(every)
    return Scalar((" && " if every else " || ").join(text_of(value, PLUS) for value in values), INT, ANY)


def _compared(operator: type[ast.cmpop], a: Value, b: Value) -> Value:
    sign, compute = COMPARED[operator]
    if isinstance(a, Constant) and isinstance(b, Constant):
        return Constant(compute(a.value, b.value))
    return Scalar(f"{text_of(a, PLUS)} {sign} {text_of(b, PLUS)}", INT, ANY)


def _chosen(body: "Body", node: ast.IfExp) -> Value:
    test = expression(body, node.test)
    if isinstance(test, Constant):
        return expression(body, node.body if test.value else node.orelse)
    a, b = expression(body, node.body), expression(body, node.orelse)
    return Scalar(f"{text_of(test, PLUS)} ? {text_of(a, PLUS)} : {text_of(b, PLUS)}", common((a, b)), ANY)


def _element(body: "Body", node: ast.Subscript) -> Value:
    owner = expression(body, node.value)
    parts = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
    if isinstance(owner, tuple):
        return owner[int(constant_of(expression(body, parts[0])))]
    if not isinstance(owner, Array):
        raise UntranslatableError(f"{ast.unparse(node)} is no element of an array")
    return element(body, owner, parts)


def element(body: "Body", owner: Array, parts: Sequence[ast.expr]) -> Array | Scalar:
    """An entry of an array, or a part of it that lies in one piece."""
    shape, fixed, moving = list[int | str | None](), 0, list[str]()
    for part, length, stride in zip(parts, owner.shape, owner.strides(), strict=False):
        if isinstance(part, ast.Slice):
            low, high = _bounds(body, part, length)
            if any(n != 1 for n in shape) or not isinstance(stride, int):
                raise UntranslatableError(f"{owner.pointer}: a part that does not lie in one piece")
            fixed += low * stride
            shape.append(max(high - low, 0))
            continue
        index = expression(body, part)
        if isinstance(index, Constant) and isinstance(stride, int):
            fixed += int(index.value) * stride
        elif not isinstance(index, Constant) or index.value:
            one = isinstance(index, Constant) and index.value == 1
            times = str(stride) if one else f"{text_of(index, TIMES)} * {stride}"
            moving.append(text_of(index, PLUS) if stride == 1 else times)
    shape += owner.shape[len(parts) :]
    offset = " + ".join([*moving, *([str(fixed)] if fixed or not moving else [])])
    if not shape:
        return Scalar(f"{owner.pointer}[{offset}]", DOUBLE)
    pointer = owner.pointer if offset == "0" else f"({owner.pointer} + {offset})"
    part_of = replace(owner, pointer=pointer, shape=tuple(shape))
    return body.pointed(part_of) if moving else part_of


def _bounds(body: "Body", part: ast.Slice, length: int | str | None) -> tuple[int, int]:
    low = 0 if part.lower is None else int(constant_of(expression(body, part.lower)))
    high = length if part.upper is None else int(constant_of(expression(body, part.upper)))
    if not isinstance(length, int) or not isinstance(high, int):
        raise UntranslatableError(f"{ast.unparse(part)}: a part of an array without a known length")
    return min(low, length), min(high, length)


def _called(body: "Body", node: ast.Call) -> Value:
    function, given = expression(body, node.func), _several(body, node.args)
    if isinstance(function, tuple):
        owner, name = function
        return _method(body, owner, name, given)
    if function is len:
        return Constant(given[0].shape[0])
    if function in (np.empty, np.zeros, np.full):
        shape = given[0] if isinstance(given[0], tuple) else (given[0],)
        filled = given[1] if function is np.full else Constant(0.0) if function is np.zeros else None
        return body.storage([int(constant_of(n)) for n in shape], filled)
    if function in OF_LIBM:
        if isinstance(given[0], Constant):
            return lifted(function(given[0].value))
        name, kind = OF_LIBM[function]
        return Scalar(f"{name}({text_of(given[0])})", kind)
    if function in OF_TWO:
        a, b = map(body.kept, given)  # of numbers that are not there the first one, as numba has it
        first, second = text_of(a, PLUS), text_of(b, PLUS)
        return Scalar(f"{second} {OF_TWO[function]} {first} ? {second} : {first}", common(given), ANY)
    if function is function_at:  # C has the function itself
        return given[0]
    if isinstance(function, type) and issubclass(function, tuple):
        return function(*given)
    return body.call(function, given)


def _method(body: "Body", owner: Array, name: str, given: Sequence[Value]) -> Array:
    if name == "copy":
        copied = body.storage(owner.shape, None)
        body.copy(copied, owner)
        return copied
    if name == "reshape":
        shape = given[0] if isinstance(given[0], tuple) else given
        return replace(owner, shape=tuple(int(constant_of(n)) for n in shape))
    raise UntranslatableError(f"the method {name} of arrays has no translation to C")
