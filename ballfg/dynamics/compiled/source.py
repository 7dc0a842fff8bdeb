"""Python source, for numba, of a scalar program and of how its outputs move with its inputs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from ballfg.dynamics.compiled.program import Number, Program

INFIX: Final = {"add": "+", "sub": "-", "mul": "*", "div": "/", "le": "<=", "ge": ">=", "lt": "<", "gt": ">"}
CALLS: Final = {
    "sqrt": "math.sqrt",
    "exp": "math.exp",
    "log": "math.log",
    "sin": "math.sin",
    "cos": "math.cos",
    "tan": "math.tan",
    "tanh": "math.tanh",
    "abs": "abs",
    "minimum": "min",
    "maximum": "max",
}


def function_source(
    program: Program, outputs: Sequence[Number], state: Sequence[Number], others: Sequence[Number]
) -> str:
    """Source of `compute(x, c, xt, ct, y, yt)`: outputs (m,) of a program, and their tangents.

    The same arithmetic has the same source, whatever else the program holds: it is known by its hash.

    Args:
        program: that holds all of it.
        outputs: m numbers, written to y.
        state: inputs that come in x, with their tangents in xt (len(state), d).
        others: inputs that come in c, with their tangents in ct (len(others), d).
    """
    inputs = {n: f"x[{i}]" for i, n in enumerate(state)} | {n: f"c[{i}]" for i, n in enumerate(others)}
    tangents = {n: f"xt[{i}, q]" for i, n in enumerate(state)} | {n: f"ct[{i}, q]" for i, n in enumerate(others)}
    slopes = [
        [
            (tangent, slope)
            for by, tangent in tangents.items()
            if program.value(slope := program.derivative(n, by)) != 0.0
        ]
        for n in outputs
    ]
    needed = program.needed([*outputs, *(slope for row in slopes for _, slope in row)])
    names = {number: f"v{place}" for place, number in enumerate(needed)}
    body = [f"{names[n]} = {_expression(program, n, names, inputs)}" for n in needed]
    body += [f"y[{i}] = {names[n]}" for i, n in enumerate(outputs)]
    body.append("for q in range(xt.shape[1]):")
    for i, row in enumerate(slopes):
        body.append(f"    yt[{i}, q] = {_sum(f'{names[slope]} * {tangent}' for tangent, slope in row)}")
    return "\n".join(["def compute(x, c, xt, ct, y, yt):", *(f"    {line}" for line in body)]) + "\n"


def _sum(terms: Iterable[str]) -> str:
    return " + ".join(terms) or "0.0"


def _expression(program: Program, number: Number, names: Mapping[Number, str], inputs: Mapping[Number, str]) -> str:
    operation = program.operations[number]
    o = [names[n] for n in operation.operands]
    match operation.name:
        case "input":
            return inputs[number]
        case "constant":
            return repr(operation.constant)
        case "neg":
            return f"-{o[0]}"
        case "where":
            return f"({o[1]} if {o[0]} else {o[2]})"
        case "sign":
            return f"(1.0 if {o[0]} > 0.0 else (-1.0 if {o[0]} < 0.0 else 0.0))"
        case "halved_inverse":
            return f"(0.5 / {o[0]} if {o[0]} > 0.0 else 0.0)"
        case "pow":
            return f"{o[0]} ** {operation.constant!r}"
        case name if name in INFIX:
            return f"{o[0]} {INFIX[name]} {o[1]}"
        case name:
            return f"{CALLS[name]}({', '.join(o)})"
