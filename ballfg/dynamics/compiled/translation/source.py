"""Writes numba source for a program and for the tangents of its outputs."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from ballfg.dynamics.compiled.translation.adjoints import carried_back
from ballfg.dynamics.compiled.translation.arrays import Load
from ballfg.dynamics.compiled.translation.loops import EACH_STATE, Entries, expression, filled, indented, moved
from ballfg.dynamics.compiled.translation.program import Number, Operation
from ballfg.dynamics.compiled.translation.trace import Traced

OF_ARRAYS = frozenset({"read", "slope", "back"})  # Operations that read arrays or their derivatives


def function_source(traced: Traced, state: Sequence[Number], others: Sequence[Number]) -> str:
    """Source of `compute(x, c, w, xt, ct, y, yt)`: outputs (n, m) of a program for n states, and their tangents.

    Equal arithmetic has equal source, whatever else the program holds: its hash identifies it.

    Args:
        traced: the program, its arrays and its outputs, which are written to y.
        state: inputs that come in x (n, len(state)), with their tangents in xt (n, len(state), d).
        others: inputs that come in c (n, len(others)), with their tangents in ct (n, len(others), d).
    """
    program, outputs = traced.program, traced.outputs
    given = [("x", i, number) for i, number in enumerate(state)] + [("c", i, number) for i, number in enumerate(others)]
    slopes = [[(name, i, program.derivative(n, by)) for name, i, by in given] for n in outputs]
    slopes = [[entry for entry in row if program.value(entry[2]) != 0.0] for row in slopes]
    values = program.needed(outputs)
    further = program.needed(number for row in slopes for _, _, number in row)
    known = set(values)
    names = {n: f"v{place}" for place, n in enumerate([*values, *(n for n in further if n not in known)])}
    writer = _Writer(traced, names, {number: f"{name}[r, {i}]" for name, i, number in given})
    writer.compute(outputs, [f"y[r, {i}] = {names[n]}" for i, n in enumerate(outputs)])
    writer.lines += ["if xt.shape[2] == 0:", "    return"]
    moving = ["for q in range(xt.shape[2]):"]
    for i, row in enumerate(slopes):
        moving.append(f"    yt[r, {i}, q] = {_sum(f'{names[n]} * {name}t[r, {j}, q]' for name, j, n in row)}")
    writer.compute([number for row in slopes for _, _, number in row], moving)
    return "\n".join(["def compute(x, c, w, xt, ct, y, yt):", *indented(["n = len(x)", *writer.lines])]) + "\n"


@dataclass
class _Writer:
    """Writes lines that compute numbers, after lines that fill the arrays they are read from."""

    traced: Traced  # the program
    names: Mapping[Number, str]  # of its numbers
    inputs: Mapping[Number, str]  # how its inputs are called
    lines: list[str] = field(default_factory=list)  # written so far
    done: set[str] = field(default_factory=set)  # blocks that are filled, or whose derivatives are, by their names
    kinds: dict[tuple[Number, ...], str] = field(default_factory=dict)
    """Names of derivatives, by the numbers with respect to which they are taken."""

    def compute(self, numbers: Sequence[Number], then: Sequence[str]) -> None:
        """Compute numbers of each state and then do something with them.

        Common subexpressions are computed in each loop, which costs less than storing them for all states.
        """
        needed, program = self._up_to_arrays(numbers), self.traced.program
        for number in needed:
            operation = program.operations[number]
            if operation.name in OF_ARRAYS:
                self._fill_for(operation)
        if then:
            body = [f"{self.names[n]} = {self._one(n)}" for n in needed]
            self.lines += [EACH_STATE, *indented([*body, *then])]

    def _up_to_arrays(self, numbers: Sequence[Number]) -> list[Number]:
        """Operations that numbers depend on, down to reads of arrays."""
        found, wanted, operations = set[Number](), list(numbers), self.traced.program.operations
        while wanted:
            number = wanted.pop()
            if number not in found:
                found.add(number)
                if operations[number].name not in OF_ARRAYS:
                    wanted += operations[number].operands
        return sorted(found)

    def _fill_for(self, operation: Operation) -> None:
        """Fills the arrays, or their derivatives, that an operation reads."""
        arrays, block = self.traced.arrays, operation.where[0]
        for source in arrays.sources(block):
            if f"a{source}" not in self.done:
                self.done.add(f"a{source}")
                self.lines += filled(arrays, source)
                self._load(source, Entries(arrays))
        if operation.name == "slope":
            by = operation.operands[1 : 1 + operation.where[2]]
            moving = self._moving(by)
            for source in arrays.sources(block):
                if moving.name(source) not in self.done:
                    self.done.add(moving.name(source))
                    self.lines += moved(arrays, source, moving)
                    self._load_slopes(source, by, moving)
        if operation.name == "back" and (adjoint := self._adjoint(block)).name(block) not in self.done:
            self.done.add(adjoint.name(block))
            self.lines += carried_back(arrays, block, arrays.asked[block], adjoint)

    def _load(self, block: int, values: Entries) -> None:
        making = self.traced.arrays.makings[block]
        if isinstance(making, Load):
            places = [values.place(block, str(i)) for i in range(len(making.numbers))]
            named = [self.names[n] for n in making.numbers]
            self.compute(making.numbers, [f"{place} = {name}" for place, name in zip(places, named, strict=True)])

    def _load_slopes(self, block: int, by: Sequence[Number], moving: Entries) -> None:
        making, program = self.traced.arrays.makings[block], self.traced.program
        if not isinstance(making, Load):
            return
        wanted, then = [], []
        for i, number in enumerate(making.numbers):
            for q, other in enumerate(by):
                slope = program.derivative(number, other)
                value, place = program.value(slope), moving.place(block, str(i), str(q))
                if value is None:
                    wanted.append(slope)
                    then.append(f"{place} = {self.names[slope]}")
                elif value:
                    then.append(f"{place} = {value!r}")
        self.compute(wanted, then)

    def _moving(self, by: tuple[Number, ...]) -> Entries:
        """Derivatives by some numbers, under a name of their own."""
        return Entries(self.traced.arrays, self.kinds.setdefault(by, f"t{len(self.kinds)}_"), len(by))

    def _adjoint(self, block: int) -> Entries:
        """Derivatives of those places of a block that are read."""
        return Entries(self.traced.arrays, f"g{block}_", len(self.traced.arrays.asked[block]))

    def _one(self, number: Number) -> str:
        """A number in terms of others and of filled arrays."""
        operation, arrays = self.traced.program.operations[number], self.traced.arrays
        if operation.name == "read":
            block, place, _ = operation.where
            return Entries(arrays).place(block, str(place))
        if operation.name == "slope":
            block, place, through, which = operation.where
            return self._moving(operation.operands[1 : 1 + through]).place(block, str(place), str(which))
        if operation.name == "back":
            block, place = operation.where
            asked, adjoint, by = str(arrays.asked[block].index(place)), self._adjoint(block), operation.operands[1]
            loads = [(source, arrays.makings[source]) for source in arrays.sources(block)]
            return _sum(
                adjoint.place(source, str(i), asked)
                for source, load in loads
                if isinstance(load, Load)
                for i, loaded in enumerate(load.numbers)
                if loaded == by
            )
        return expression(self.traced.program, number, self.names, self.inputs)


def _sum(terms: Iterable[str]) -> str:
    return " + ".join(terms) or "0.0"
