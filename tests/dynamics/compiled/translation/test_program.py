"""Scalar programs and their derivatives against plain Python and central differences."""

import math

import numpy as np
import pytest

from ballfg.dynamics.compiled.build import built
from ballfg.dynamics.compiled.translation.arrays import Arrays
from ballfg.dynamics.compiled.translation.program import Program
from ballfg.dynamics.compiled.translation.source import function_source
from ballfg.dynamics.compiled.translation.trace import Traced

UNARY = {
    "neg": lambda a: -a,
    "sqrt": math.sqrt,
    "exp": math.exp,
    "log": math.log,
    "sin": math.sin,
    "cos": math.cos,
    "tan": math.tan,
    "tanh": math.tanh,
    "abs": abs,
}
BINARY = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "minimum": min,
    "maximum": max,
}


def whole(program, outputs):
    return Traced(program, Arrays(program), [], outputs, None)


def run(program, outputs, state, others, x, c):
    """Values (m,) and the derivatives (m, len(x) + len(c)) that the generated code gives."""
    compute = built(function_source(whole(program, outputs), state, others))
    eye = np.eye(len(x) + len(c))[None]
    y, yt = np.zeros((1, len(outputs))), np.zeros((1, len(outputs), eye.shape[1]))
    given = (np.array([x], dtype=np.float64), np.array([c], dtype=np.float64), np.zeros(0))
    compute(*given, eye[:, : len(x)].copy(), eye[:, len(x) :].copy(), y, yt)
    return y[0], yt[0]


@pytest.mark.parametrize("name", UNARY)
def test_functions_of_one_number(name) -> None:
    program = Program()
    a = program.input()
    y, yt = run(program, [program.apply(name, a)], [a], [], [0.7], [])
    assert y[0] == pytest.approx(UNARY[name](0.7), rel=1e-15)
    assert yt[0, 0] == pytest.approx((UNARY[name](0.7 + 1e-6) - UNARY[name](0.7 - 1e-6)) / 2e-6, rel=1e-8)


@pytest.mark.parametrize("name", BINARY)
def test_functions_of_two_numbers(name) -> None:
    program = Program()
    a, b = program.input(), program.input()
    y, yt = run(program, [program.apply(name, a, b)], [a], [b], [0.7], [1.3])
    assert y[0] == pytest.approx(BINARY[name](0.7, 1.3), rel=1e-15)
    by = [
        (BINARY[name](0.7 + d, 1.3 + e) - BINARY[name](0.7 - d, 1.3 - e)) / 2e-6 for d, e in ((1e-6, 0.0), (0.0, 1e-6))
    ]
    np.testing.assert_allclose(yt[0], by, rtol=1e-8, atol=1e-9)


def test_powers_choices_and_the_chain_rule() -> None:
    program = Program()
    a, b = program.input(), program.input()
    chosen = program.apply("where", program.apply("lt", a, b), program.apply("mul", a, b), program.apply("sub", a, b))
    out = program.apply("pow", program.apply("add", chosen, program.apply("exp", a)), constant=1.5)

    def plain(x, y):
        return ((x * y if x < y else x - y) + math.exp(x)) ** 1.5

    for x, y in ((0.4, 0.9), (0.9, 0.4)):
        value, slopes = run(program, [out], [a], [b], [x], [y])
        assert value[0] == pytest.approx(plain(x, y), rel=1e-14)
        by = [(plain(x + 1e-6, y) - plain(x - 1e-6, y)) / 2e-6, (plain(x, y + 1e-6) - plain(x, y - 1e-6)) / 2e-6]
        np.testing.assert_allclose(slopes[0], by, rtol=1e-8)


def test_nothing_is_computed_that_is_known() -> None:
    program = Program()
    a, zero, one = program.input(), program.constant(0.0), program.constant(1.0)
    assert program.apply("add", a, zero) == a
    assert program.apply("mul", one, a) == a
    assert program.value(program.apply("mul", a, zero)) == 0.0
    assert program.apply("add", a, one) == program.apply("add", one, a)
    assert program.value(program.apply("sqrt", program.constant(4.0))) == 2.0


def test_source_does_not_depend_on_what_else_a_program_holds() -> None:
    short, long = Program(), Program()
    long.apply("exp", long.input())
    sources = []
    for program in (short, long):
        a, b = program.input(), program.input()
        sources.append(function_source(whole(program, [program.apply("mul", a, b)]), [a], [b]))
    assert sources[0] == sources[1]
