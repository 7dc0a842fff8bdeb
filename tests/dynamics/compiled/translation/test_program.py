"""Scalar programs and their derivatives against plain Python and central differences."""

import math

import numpy as np
import pytest
import torch

from ballfg.dynamics.compiled.build import built
from ballfg.dynamics.compiled.translation.arrays import Arrays
from ballfg.dynamics.compiled.translation.program import Program
from ballfg.dynamics.compiled.translation.source import function_source
from ballfg.dynamics.compiled.translation.trace import Traced, trace

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


def test_shapes_of_all_kinds() -> None:
    def shapes(x):
        rows = (2.0 * x[:6]).view(2, 3)
        same = (rows + 1.0).squeeze_(0) * rows.unsqueeze(1).squeeze(0).squeeze_(1)  # only sides of one are taken away
        turned = torch.stack((same, rows.flip([1]))).permute(2, 0, 1)
        long, short = turned.split(2)
        first, middle, last = x.split_with_sizes([2, 3, 4])
        ends = torch.cat([one.unsqueeze(0).expand(2, -1).reshape(-1) for one in middle.view(3, 1).unbind(0)])
        return torch.cat((long.reshape(-1), short.sum((0, 1)), first.select(0, 1).view(1), last[1:3], ends))

    traced, x = trace(shapes, [9]), np.linspace(0.5, 1.3, 9)
    y, yt = run(traced.program, traced.outputs, traced.inputs[0], [], x, [])
    point = torch.from_numpy(x)
    np.testing.assert_allclose(y, shapes(point).numpy(), rtol=1e-14)
    np.testing.assert_allclose(yt, torch.autograd.functional.jacobian(shapes, point).numpy(), rtol=1e-12, atol=1e-13)


def test_sums_norms_and_choices_of_all_kinds() -> None:
    def numbers(x):
        a, b = x[:3] - 0.67, x[3:6]
        m = x.view(3, 3)
        one = torch.where(a < 0.1, a.clamp(-0.05, 0.08), a.clamp_max(0.2)) + torch.where(b >= 1.0, b, b.clamp_min(0.95))
        two = torch.linalg.vector_norm(m, dim=1) + m.mean(0) + m.mean() * torch.sign(a) + torch.abs(a)
        cross = torch.linalg.cross(a, b) * b.rsqrt() + torch.minimum(a, b).square() - torch.maximum(a, -b).reciprocal()
        three = torch.addcmul(a, b, cross) + torch.where(a > b - 0.6, torch.zeros_like(a), torch.ones_like(a))
        four = torch.nn.functional.pad(a, (1, 0)) + torch.cat((m.index_select(1, torch.tensor([2, 0]))[0], a[:2] ** 3))
        five = (
            torch.where(a <= 0.0, (m @ b.view(3, 1)).squeeze(1), torch.tan(b))
            + torch.log(b) / torch.cos(a)
            - torch.sin(a) * torch.tanh(b)
        )
        return torch.cat((one, two, cross, three, four, five, (a.sum() + m.t().sum(1, keepdim=True)).flatten()))

    traced, x = trace(numbers, [9]), np.linspace(0.5, 1.3, 9)
    y, yt = run(traced.program, traced.outputs, traced.inputs[0], [], x, [])
    point = torch.from_numpy(x)
    np.testing.assert_allclose(y, numbers(point).numpy(), rtol=1e-13)
    np.testing.assert_allclose(yt, torch.autograd.functional.jacobian(numbers, point).numpy(), rtol=1e-11, atol=1e-12)
