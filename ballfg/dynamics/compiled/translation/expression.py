"""Writes one operation on numbers as Python source."""

from collections.abc import Mapping
from typing import Final

from ballfg.dynamics.compiled.translation.program import Number, Program

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


def expression(program: Program, number: Number, names: Mapping[Number, str], inputs: Mapping[Number, str]) -> str:
    """Source of the operation that gives a number, in terms of its operands' names."""
    operation = program.operations[number]
    o = [names[n] for n in operation.operands]
    match operation.name:
        case "input":
            return inputs[number]
        case "weight":
            return f"w[{operation.where[0]}]"
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
