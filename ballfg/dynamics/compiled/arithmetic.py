"""Compiles loops of plain arithmetic straight to LLVM: numba takes milliseconds to type and lower each operation.

A generated function has thousands of operations, each of which is a float64's, an index's or a comparison's, so that
there is nothing to infer. Its source stays its definition, in Python.
"""

import ast
import math
import operator
from collections.abc import Callable, Mapping
from typing import Any, Final

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

REAL: Final = ir.DoubleType()
WHOLE: Final = ir.IntType(64)
BINARY: Final = {ast.Add: "add", ast.Sub: "sub", ast.Mult: "mul", ast.Div: "div"}
COMPARED: Final = {ast.LtE: "<=", ast.GtE: ">=", ast.Lt: "<", ast.Gt: ">"}
CHOSEN: Final = {"max": ">", "min": "<"}
"""How the second number compares where it is taken: as in Python, which keeps the first of equal ones, and of NaN."""


def lowered(tree: ast.Module) -> tuple[ast.Module, dict[str, Any]]:
    """A generated module with calls in place of the loops that hold arithmetic only, and what these calls name.

    Args: tree: whose last statement is the function. It is changed.
    """
    loops = dict[str, Any]()
    *_, function = tree.body
    assert isinstance(function, ast.FunctionDef)
    for place, node in enumerate(function.body):
        if isinstance(node, ast.For) and not any(isinstance(part, ast.Expr) for part in ast.walk(node)):
            name, given = f"loop_{len(loops)}", _given(node)
            loops[name] = _compiled_loop(node, given)
            call = ast.parse(f"{name}(({', '.join(given)},))").body[0]
            function.body[place] = ast.fix_missing_locations(ast.copy_location(call, node))
    return tree, loops


def _given(loop: ast.For) -> list[str]:
    """The arrays and counts that a loop takes from around it."""
    names = [node for node in ast.walk(loop) if isinstance(node, ast.Name)]
    made = {node.id for node in names if isinstance(node.ctx, ast.Store)}
    return sorted({node.id for node in names} - made - {"math", "range", "abs", *CHOSEN})


def _compiled_loop(loop: ast.For, given: list[str]) -> Any:
    """What numba calls for a loop, with a tuple of what it takes."""

    def typed(_context: Any, kinds: Any) -> Any:
        def write(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
            values = dict(zip(given, cgutils.unpack_tuple(builder, arguments[0]), strict=True))
            arrays = {name: kind for name, kind in zip(given, kinds, strict=True) if isinstance(kind, types.Array)}
            whole = {name: context.make_array(kind)(context, builder, values[name]) for name, kind in arrays.items()}
            shapes = {name: cgutils.unpack_tuple(builder, array.shape) for name, array in whole.items()}
            values |= {name: array.data for name, array in whole.items()}
            _Writer(context, builder, shapes).run([loop], values)
            return context.get_dummy_value()

        return types.void(kinds), write

    return intrinsic(typed)


class _Writer:
    """Writes the instructions of statements."""

    def __init__(self, context: Any, builder: Any, shapes: Mapping[str, list[Any]]) -> None:
        self._context, self._builder, self._shapes = context, builder, shapes

    def run(self, statements: list[ast.stmt], known: Mapping[str, Any]) -> None:
        """Write statements, which see the names around them; theirs are of no use after them."""
        values = dict(known)
        for statement in statements:
            match statement:
                case ast.For(target=ast.Name(id=index), iter=ast.Call(args=[count]), body=body):
                    with cgutils.for_range(self._builder, self._value(count, values), intp=WHOLE) as loop:
                        self.run(body, {**values, index: loop.index})
                case ast.Assign(targets=[ast.Name(id=name)], value=value):
                    values[name] = self._value(value, values)
                case ast.Assign(targets=[ast.Subscript() as place], value=value):
                    self._builder.store(self._value(value, values), self._pointer(place, values))
                case ast.AugAssign(target=ast.Subscript() as place, op=ast.Add(), value=value):
                    pointer, more = self._pointer(place, values), self._value(value, values)
                    self._builder.store(self._builder.fadd(self._builder.load(pointer), more), pointer)
                case _:
                    raise NotImplementedError(ast.unparse(statement))

    def _value(self, node: ast.expr, values: Mapping[str, Any]) -> Any:
        match node:
            case ast.Constant(value=number):
                return ir.Constant(REAL if isinstance(number, float) else WHOLE, number)
            case ast.Name(id=name):
                return values[name]
            case ast.Subscript(value=ast.Attribute(value=ast.Name(id=name)), slice=ast.Constant(value=int(dimension))):
                return self._shapes[name][dimension]
            case ast.Subscript():
                return self._builder.load(self._pointer(node, values))
        return self._operation(node, lambda *parts: [self._value(part, values) for part in parts])

    def _operation(self, node: ast.expr, found: Callable[..., list[Any]]) -> Any:
        """The result of an operation, whose operands have the values that are `found` of them."""
        match node:
            case ast.IfExp(test=test, body=body, orelse=other):
                return self._builder.select(*found(test, body, other))
            case ast.Compare(left=left, ops=[kind], comparators=[right]):
                return self._builder.fcmp_ordered(COMPARED[type(kind)], *found(left, right))
            case ast.BinOp(left=left, op=ast.Pow(), right=right):
                return self._call(operator.pow, *found(left, right))
            case ast.BinOp(left=left, op=kind, right=right) if type(kind) in BINARY:
                one, other = found(left, right)
                return getattr(self._builder, ("f" if one.type == REAL else "") + BINARY[type(kind)])(one, other)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return self._call(operator.neg, *found(operand))
            case ast.Call(func=ast.Attribute(attr=name), args=arguments):
                return self._call(getattr(math, name), *found(*arguments))
            case ast.Call(func=ast.Name(id="abs"), args=[argument]):
                return self._call(abs, *found(argument))
            case ast.Call(func=ast.Name(id=name), args=[one, other]):
                first, second = found(one, other)
                return self._builder.select(self._builder.fcmp_ordered(CHOSEN[name], second, first), second, first)
        raise NotImplementedError(ast.unparse(node))

    def _call(self, function: Any, *arguments: Any) -> Any:
        """A function of numbers, as numba has it."""
        made = self._context.get_function(function, types.float64(*[types.float64] * len(arguments)))
        return made(self._builder, arguments)

    def _pointer(self, place: ast.Subscript, values: Mapping[str, Any]) -> Any:
        """Where an entry of an array lies, whose rows lie one behind another."""
        assert isinstance(place.value, ast.Name)
        name, at = place.value.id, place.slice
        first, *others = at.elts if isinstance(at, ast.Tuple) else [at]
        index = self._value(first, values)
        for length, other in zip(self._shapes[name][1:], others, strict=True):
            index = self._builder.add(self._builder.mul(index, length), self._value(other, values))
        return self._builder.gep(values[name], [index], inbounds=True)
