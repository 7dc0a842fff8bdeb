"""Python source, for numba, of the arrays of a program: loops that fill them, and their derivatives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from ballfg.dynamics.compiled.translation.arrays import Arrays, Each, Load, Product, Total, View
from ballfg.dynamics.compiled.translation.expression import expression
from ballfg.dynamics.compiled.translation.program import Number, Program

Names = Mapping[Number, str]
"""How numbers of the program are called in the source."""


def filled(arrays: Arrays, block: int, names: Names) -> list[str]:
    """Lines that fill a block, `a<block>`, from numbers of the program, from weights `w` and from other blocks."""
    making, values = arrays.makings[block], _Entries(arrays)
    name = values.name(block)
    lines = [f"{name} = np.{'zeros' if isinstance(making, Product | Total) else 'empty'}({arrays.sizes[block]})"]
    match making:
        case Load(numbers):
            lines += [f"{name}[{i}] = {names[n]}" for i, n in enumerate(numbers)]
        case Each():
            whole = View.whole(block, making.operands[0].shape)
            given = {n: values.at(v, "i") for n, v in zip(making.inputs, making.operands, strict=True)}
            body, called = _computed(making.program, [making.result], given)
            lines += _loops(whole.shape, "i", [*body, f"{values.at(whole, 'i')} = {called[making.result]}"])
        case Product(left, right, plus):
            if plus is not None:
                whole = View.whole(block, plus.shape)
                lines += _loops(plus.shape, "i", [f"{values.at(whole, 'i')} = {values.at(plus, 'i')}"])
            lines.append(_product(block, values, (left, values), (right, values)))
        case Total(of, summed):
            whole = View.whole(block, of.shape[summed:])
            lines += _loops(of.shape, "i", [f"{values.at(whole, 'i', summed)} += {values.at(of, 'i')}"])
    return lines


def moved(
    arrays: Arrays, block: int, by: Sequence[Number], kind: str, slope: Callable[[Number, Number], str]
) -> list[str]:
    """Lines that fill the derivatives of a block by some numbers of the program, one after another.

    Args: kind: what their names begin with.  slope: gives the name of a number's derivative by another.
    """
    making, values, moving = arrays.makings[block], _Entries(arrays), _Entries(arrays, kind)
    name, size = moving.name(block), arrays.sizes[block]
    lines = [f"{name} = np.zeros({len(by) * size})"]
    each_by = f"for q in range({len(by)}):"
    match making:
        case Load(numbers):
            for i, number in enumerate(numbers):
                lines += [f"{name}[{q * size + i}] = {s}" for q, b in enumerate(by) if (s := slope(number, b)) != "0.0"]
        case Each():
            whole, program = View.whole(block, making.operands[0].shape), making.program
            given = {n: values.at(v, "i") for n, v in zip(making.inputs, making.operands, strict=True)}
            given[making.result] = values.at(whole, "i")  # computed already
            blocks = [(n, v) for n, v in zip(making.inputs, making.operands, strict=True) if v.block is not None]
            partials = {n: program.derivative(making.result, n) for n, _ in blocks}
            body, called = _computed(program, list(partials.values()), given)
            terms = [f"{called[partials[n]]} * {moving.at(v, 'i')}" for n, v in blocks]
            if terms:
                set_one = f"    {moving.at(whole, 'i')} = {' + '.join(terms)}"
                lines += _loops(whole.shape, "i", [*body, each_by, set_one])
        case Product(left, right, plus):
            if plus is not None and plus.block is not None:
                whole = View.whole(block, plus.shape)
                lines.append(each_by)
                lines += _indented(_loops(plus.shape, "i", [f"{moving.at(whole, 'i')} = {moving.at(plus, 'i')}"]))
            if left.block is not None:
                lines.append(_product(block, moving, (left, moving), (right, values), len(by)))
            if right.block is not None:
                lines.append(_product(block, moving, (left, values), (right, moving), len(by)))
        case Total(of, summed):
            whole = View.whole(block, of.shape[summed:])
            inner = _loops(of.shape, "i", [f"{moving.at(whole, 'i', summed)} += {moving.at(of, 'i')}"])
            lines += [each_by, *_indented(inner)]
    return lines


@dataclass(frozen=True)
class _Entries:
    """How entries of blocks are called: their values, or (of another kind) their derivatives by number q."""

    arrays: Arrays
    kind: str = "a"

    def name(self, block: int | None) -> str:
        """Of a block, or of the weights."""
        return "w" if block is None else f"{self.kind}{block}"

    def step(self, block: int | None) -> int:
        """How far the derivatives by the next number lie behind; 0 for values."""
        return 0 if block is None or self.kind == "a" else self.arrays.sizes[block]

    def at(self, view: View, index: str, first: int = 0) -> str:
        """The entry of a view at the indices of its loops; the first loops are not its own."""
        indices = [f"{index}{dim + first}" for dim in range(len(view.shape))]
        terms = [i if s == 1 else f"{i} * {s}" for i, s in zip(indices, view.strides, strict=True) if s]
        if step := self.step(view.block):
            terms.append(f"q * {step}")
        if view.offset or not terms:
            terms.append(str(view.offset))
        return f"{self.name(view.block)}[{' + '.join(terms)}]"


def _product(
    block: int, whole: _Entries, left: tuple[View, _Entries], right: tuple[View, _Entries], count: int = 1
) -> str:
    """The call that adds a product of matrices to a block, or so many products to its derivatives."""
    called = [whole.name(block), str(whole.step(block))]
    for view, entries in (left, right):
        places = (view.offset, entries.step(view.block), *view.strides)
        called += [entries.name(view.block), *map(str, places)]
    sizes = (count, *left[0].shape, right[0].shape[1])
    return f"add_product({', '.join(called)}, {', '.join(map(str, sizes))})"


def _computed(program: Program, results: Sequence[Number], given: Names) -> tuple[list[str], dict[Number, str]]:
    """Lines that compute results of a small program, and how its numbers are called; `given` ones are known."""
    needed, wanted = set[Number](), list(results)
    while wanted:
        number = wanted.pop()
        if number not in needed and number not in given:
            needed.add(number)
            wanted += program.operations[number].operands
    names = {**given, **{n: f"e{n}" for n in needed}}
    return [f"{names[n]} = {expression(program, n, names, {})}" for n in sorted(needed)], names


def _loops(shape: Sequence[int], index: str, body: Sequence[str]) -> list[str]:
    """Loops over all entries of a shape, the last dimension innermost."""
    lines, depth = [], 0
    for dim, length in enumerate(shape):
        lines.append("    " * depth + f"for {index}{dim} in range({length}):")
        depth += 1
    return [*lines, *("    " * depth + line for line in body)]


def _indented(lines: Sequence[str]) -> list[str]:
    return [f"    {line}" for line in lines]
