"""Translates statements of Python functions to C."""

import ast
from collections.abc import Sequence
from typing import TYPE_CHECKING

from ballfg.dynamics.compiled.in_c.expressions import constant_of, element, expression
from ballfg.dynamics.compiled.in_c.values import (
    ATOM,
    DOUBLE,
    INT,
    PLUS,
    Array,
    Constant,
    Scalar,
    UntranslatableError,
    text_of,
)

if TYPE_CHECKING:
    from ballfg.dynamics.compiled.in_c.body import Body
    from ballfg.dynamics.compiled.in_c.values import Value


def block(body: "Body", statements: Sequence[ast.stmt]) -> bool:
    """Translate statements; True if the last one leaves the block, so that nothing after it is reached."""
    return any(_statement(body, statement) for statement in statements)


def _statement(body: "Body", node: ast.stmt) -> bool:
    match node:
        case ast.Expr(value=ast.Constant()) | ast.Pass():
            return False
        case ast.Expr():
            value = expression(body, node.value)
            if isinstance(value, Scalar):
                body.line(f"(void){value.text};")
        case ast.Assign():
            value = expression(body, node.value)
            for target in node.targets:
                bind(body, target, value)
        case ast.AugAssign():
            target = ast.parse(ast.unparse(node.target), mode="eval").body  # as an expression that is read
            sum_of = ast.BinOp(target, node.op, node.value)
            bind(body, node.target, expression(body, sum_of))
        case ast.If():
            return _if(body, node)
        case ast.For():
            _for(body, node)
        case ast.While():
            body.line("while (1) {")
            with body.indented():
                body.line(f"if (!{text_of(expression(body, node.test), ATOM)}) break;")
                block(body, node.body)
            body.line("}")
        case ast.Return():
            body.leave(() if node.value is None else expression(body, node.value))
            return True
        case ast.Break() | ast.Continue():
            body.line("break;" if isinstance(node, ast.Break) else "continue;")
            return True
        case _:
            raise UntranslatableError(f"{ast.unparse(node)} has no translation to C")
    return False


def bind(body: "Body", target: ast.expr, value: "Value") -> None:
    """Give a name a value, or write to entries of an array."""
    if isinstance(target, ast.Tuple):
        still = all(isinstance(part, ast.Name) and part.id not in body.routine.changing for part in target.elts)
        for part, one in zip(target.elts, value if still else list(map(body.kept, value)), strict=True):
            bind(body, part, one)
    elif isinstance(target, ast.Name):
        body.name(target.id, value)
    elif isinstance(target, ast.Subscript):
        owner = expression(body, target.value)
        parts = target.slice.elts if isinstance(target.slice, ast.Tuple) else [target.slice]
        into = element(body, owner, parts)
        body.written.add(owner.root)
        if isinstance(into, Scalar):
            body.line(f"{into.text} = {text_of(value)};")
        elif isinstance(value, Array):
            body.copy(into, value)
        else:
            body.fill(into, value)


def _if(body: "Body", node: ast.If) -> bool:
    test = expression(body, node.test)
    if isinstance(test, Constant):
        return block(body, node.body if test.value else node.orelse)
    body.line(f"if ({text_of(test)}) {{")
    with body.indented():
        left = block(body, node.body)
    if node.orelse:
        body.line("} else {")
        with body.indented():
            left = block(body, node.orelse) and left
    body.line("}")
    return left and bool(node.orelse)


def _for(body: "Body", node: ast.For) -> None:
    if isinstance(node.iter, ast.Call) and ast.unparse(node.iter.func) == "range":
        bounds = [expression(body, bound) for bound in node.iter.args]
        low, high = (Constant(0), *bounds)[-2:]
        _counted(body, node, low, high)
        return
    over = expression(body, node.iter)
    if isinstance(over, Array):
        index = body.fresh("i")
        body.line(f"for (int {index} = 0; {index} < {over.size}; ++{index}) {{")
        with body.indented():
            bind(body, node.target, Scalar(f"{over.pointer}[{index}]", DOUBLE))
            block(body, node.body)
        body.line("}")
        return
    for value in over:  # a tuple of constants
        body.line("{")
        with body.indented():
            bind(body, node.target, value)
            block(body, node.body)
        body.line("}")


def _counted(body: "Body", node: ast.For, low: "Value", high: "Value") -> None:
    """A loop over numbers; of one number it is its body alone, of none nothing."""
    assert isinstance(node.target, ast.Name)
    known = isinstance(low, Constant) and isinstance(high, Constant)
    if known and constant_of(high) <= constant_of(low):
        return
    once = known and constant_of(high) == constant_of(low) + 1
    if once and not any(isinstance(inner, ast.Break | ast.Continue) for inner in ast.walk(node)):
        body.names[node.target.id] = low
        block(body, node.body)
        return
    index = body.fresh(node.target.id)
    body.names[node.target.id] = low if once else Scalar(index, INT)
    body.line("do {" if once else f"for (int {index} = {text_of(low)}; {index} < {text_of(high, PLUS)}; ++{index}) {{")
    with body.indented():
        block(body, node.body)
    body.line("} while (0);" if once else "}")
