"""Python source, for numba, of a scalar program and of how its outputs move with its inputs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from ballfg.dynamics.compiled.translation import loops
from ballfg.dynamics.compiled.translation.expression import expression
from ballfg.dynamics.compiled.translation.program import Number
from ballfg.dynamics.compiled.translation.trace import Traced


def function_source(traced: Traced, state: Sequence[Number], others: Sequence[Number]) -> str:
    """Source of `compute(x, c, w, xt, ct, y, yt)`: outputs (m,) of a program, and their tangents.

    The same arithmetic has the same source, whatever else the program holds: it is known by its hash.

    Args:
        traced: the program, its arrays and its outputs, which are written to y.
        state: inputs that come in x, with their tangents in xt (len(state), d).
        others: inputs that come in c, with their tangents in ct (len(others), d).
    """
    program, outputs = traced.program, traced.outputs
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
    values = program.needed(outputs)
    known = set(values)
    further = [n for n in program.needed(slope for row in slopes for _, slope in row) if n not in known]
    names = {number: f"v{place}" for place, number in enumerate([*values, *further])}
    writer = _Writer(traced, names, inputs)
    body = [line for n in values for line in writer.lines(n)]
    body += [f"y[{i}] = {names[n]}" for i, n in enumerate(outputs)]
    body += ["if xt.shape[1] == 0:", "    return"]
    body += [line for n in further for line in writer.lines(n)]
    body.append("for q in range(xt.shape[1]):")
    for i, row in enumerate(slopes):
        body.append(f"    yt[{i}, q] = {_sum(f'{names[slope]} * {tangent}' for tangent, slope in row)}")
    return "\n".join(["def compute(x, c, w, xt, ct, y, yt):", *(f"    {line}" for line in body)]) + "\n"


@dataclass
class _Writer:
    """Writes numbers one by one, and the arrays that they are read from before the first of them."""

    traced: Traced
    names: Mapping[Number, str]
    inputs: Mapping[Number, str]
    filled: set[int] = field(default_factory=set)
    moved: set[tuple[int, tuple[Number, ...]]] = field(default_factory=set)
    kinds: dict[tuple[Number, ...], str] = field(default_factory=dict)

    def lines(self, number: Number) -> list[str]:
        """What computes a number."""
        operation, arrays, name = self.traced.program.operations[number], self.traced.arrays, self.names[number]
        if operation.name == "read":
            block, place, _ = operation.where
            lines = []
            for source in arrays.sources(block):
                if source not in self.filled:
                    self.filled.add(source)
                    lines += loops.filled(arrays, source, self.names)
            return [*lines, f"{name} = a{block}[{place}]"]
        if operation.name == "slope":
            block, place, through, which = operation.where
            by = operation.operands[1 : 1 + through]
            kind = self.kinds.setdefault(by, f"t{len(self.kinds)}_")
            lines = []
            for source in arrays.sources(block):
                if (source, by) not in self.moved:
                    self.moved.add((source, by))
                    lines += loops.moved(arrays, source, by, kind, self._slope)
            return [*lines, f"{name} = {kind}{block}[{which * arrays.sizes[block] + place}]"]
        return [f"{name} = {expression(self.traced.program, number, self.names, self.inputs)}"]

    def _slope(self, number: Number, by: Number) -> str:
        slope = self.traced.program.derivative(number, by)
        value = self.traced.program.value(slope)
        return self.names[slope] if value is None else repr(value)


def _sum(terms: Iterable[str]) -> str:
    return " + ".join(terms) or "0.0"
