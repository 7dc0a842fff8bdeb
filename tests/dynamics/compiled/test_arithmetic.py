"""Loops of arithmetic that are written to LLVM, against Python, which runs the same source."""

import ast
import math

import numpy as np
import pytest

from ballfg.dynamics.compiled.arithmetic import lowered
from ballfg.dynamics.compiled.build import built

SOURCE = """
def compute(x, c, w, xt, ct, y, yt):
    n = len(x)
    a0 = np.zeros(n * 6)
    for r in range(n):
        for i0 in range(3):
            for i1 in range(2):
                e0 = x[r, 2] / w[i0 * 2 + i1]
                a0[r * 6 + i0 * 2 + i1] = e0 * e0 - w[1]
                a0[r * 6 + i0 * 2 + i1] += c[r, 1]
    for r in range(n):
        v0 = x[r, 0]
        v1 = c[r, 0]
        v2 = max(v0, v1)
        v3 = min(v0, v1)
        v4 = v0 <= v1
        v5 = 0.25
        v6 = (v5 if v4 else (1.0 if v1 > 0.0 else (-1.0 if v1 < 0.0 else 0.0)))
        v7 = (v2 if v3 >= v5 else -v3)
        v8 = math.sqrt(abs(v0)) + a0[r * 6 + 5]
        y[r, 0] = v2
        y[r, 1] = v3
        y[r, 2] = v6
        y[r, 3] = v7
        y[r, 4] = v8
    if xt.shape[2] == 0:
        return
    for r in range(n):
        v0 = x[r, 0]
        for q in range(xt.shape[2]):
            yt[r, 0, q] = v0 * xt[r, 2, q] + w[3] * ct[r, 1, q] - -1.5
"""
NUMBERS = np.array([0.0, -0.0, 0.3, -1.7, 2.5, math.nan, math.inf, -math.inf])


@pytest.mark.parametrize("tangents", [0, 1, 7])
def test_every_bit_is_that_of_python(tangents: int) -> None:
    rng = np.random.default_rng(3)
    first, second = (values.ravel() for values in np.meshgrid(NUMBERS, NUMBERS))
    n = len(first)
    x = np.column_stack((first, rng.normal(size=n), rng.normal(size=n)))
    c, w = np.column_stack((second, rng.normal(size=n))), rng.uniform(0.5, 2.0, size=6)
    xt, ct = rng.normal(size=(n, 3, tangents)), rng.normal(size=(n, 2, tangents))
    plain: dict = {"np": np, "math": math}
    exec(SOURCE, plain)
    found = []
    with np.errstate(invalid="ignore"):  # infinity less infinity
        for compute in (built(SOURCE.lstrip()), plain["compute"]):
            y, yt = np.zeros((n, 5)), np.zeros((n, 1, tangents))
            compute(x, c, w, xt, ct, y, yt)
            found.append(np.concatenate((y.ravel(), yt.ravel())))
    one, other = found
    numbers = ~np.isnan(other)
    assert np.array_equal(np.isnan(one), ~numbers)
    assert np.array_equal(one[numbers].view(np.int64), other[numbers].view(np.int64))


def test_loops_of_arithmetic_are_taken_and_loops_with_calls_are_left() -> None:
    calls = SOURCE + "    for r in range(n):\n        add_product(a0, r, w)\n"
    tree, loops = lowered(ast.parse(calls))
    assert ast.unparse(tree).splitlines()[3:] == [
        "    loop_0((a0, c, n, w, x))",
        "    loop_1((a0, c, n, x, y))",
        "    if xt.shape[2] == 0:",
        "        return",
        "    loop_2((ct, n, w, x, xt, yt))",
        "    for r in range(n):",
        "        add_product(a0, r, w)",
    ]
    assert sorted(loops) == ["loop_0", "loop_1", "loop_2"]


def test_what_has_no_translation_is_named() -> None:
    loop = "    n = len(x)\n    for r in range(n):\n        y[r, 0] = x[r, 0] // 2.0\n"
    with pytest.raises(NotImplementedError, match=r"x\[r, 0\] // 2\.0"):
        built(f"def compute(x, c, w, xt, ct, y, yt):\n{loop}")
