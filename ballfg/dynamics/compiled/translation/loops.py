"""Python source, for numba, of the arrays of a program: loops that fill them, and their derivatives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

from ballfg.dynamics.compiled.translation.arrays import Arrays, Each, Load, Product, Total, View
from ballfg.dynamics.compiled.translation.program import Number, Program

Names = Mapping[Number, str]
"""How numbers of the program are called in the source."""


def filled(arrays: Arrays, block: int, names: Names) -> list[str]:
    """Lines that fill a block, `a<block>`, from numbers of the program, from weights `w` and from other blocks."""
    making, name = arrays.makings[block], f"a{block}"
    lines = [f"{name} = np.empty({arrays.sizes[block]})"]
    match making:
        case Load(numbers):
            lines += [f"{name}[{i}] = {names[n]}" for i, n in enumerate(numbers)]
        case Each():
            whole = View.whole(block, making.operands[0].shape)
            given = {n: _entry(v, "i") for n, v in zip(making.inputs, making.operands, strict=True)}
            body, called = _computed(making.program, [making.result], given)
            lines += _loops(whole.shape, "i", [*body, f"{_entry(whole, 'i')} = {called[making.result]}"])
        case Product(left, right, plus):
            lines += _product(left, right, block, _value, first="0.0" if plus is None else _entry(plus, "i"))
        case Total(of, summed):
            whole = View.whole(block, of.shape[summed:])
            lines += [f"{name}[:] = 0.0"]
            lines += _loops(of.shape, "i", [f"{_entry(whole, 'i', summed)} += {_entry(of, 'i')}"])
    return lines


def moved(
    arrays: Arrays, block: int, by: Sequence[Number], kind: str, slope: Callable[[Number, Number], str]
) -> list[str]:
    """Lines that fill the derivatives of a block by some numbers of the program, (len(by), size).

    Args: kind: what their names begin with.  slope: gives the name of a number's derivative by another.
    """
    making, name = arrays.makings[block], f"{kind}{block}"
    lines = [f"{name} = np.zeros(({len(by)}, {arrays.sizes[block]}))"]
    each_by = f"for q in range({len(by)}):"
    match making:
        case Load(numbers):
            for i, number in enumerate(numbers):
                lines += [f"{name}[{q}, {i}] = {s}" for q, b in enumerate(by) if (s := slope(number, b)) != "0.0"]
        case Each():
            whole, program = View.whole(block, making.operands[0].shape), making.program
            given = {n: _entry(v, "i") for n, v in zip(making.inputs, making.operands, strict=True)}
            given[making.result] = _entry(whole, "i")  # computed already
            moving = [(n, v) for n, v in zip(making.inputs, making.operands, strict=True) if v.block is not None]
            partials = {n: program.derivative(making.result, n) for n, _ in moving}
            body, called = _computed(program, list(partials.values()), given)
            terms = [f"{called[partials[n]]} * {_entry(v, 'i', kind=kind)}" for n, v in moving]
            if terms:
                set_one = f"    {_entry(whole, 'i', kind=kind)} = {' + '.join(terms)}"
                lines += _loops(whole.shape, "i", [*body, each_by, set_one])
        case Product(left, right, plus):
            inner: list[str] = []
            if left.block is not None:
                inner += _product(left, right, block, partial(_left_moves, kind), first=None)
            if right.block is not None:
                inner += _product(left, right, block, partial(_right_moves, kind), first=None)
            if plus is not None and plus.block is not None:
                whole = View.whole(block, plus.shape)
                inner += _loops(plus.shape, "i", [f"{_entry(whole, 'i', kind=kind)} += {_entry(plus, 'i', kind=kind)}"])
            lines += [each_by, *_indented(inner)]
        case Total(of, summed):
            whole = View.whole(block, of.shape[summed:])
            inner = _loops(of.shape, "i", [f"{_entry(whole, 'i', summed, kind)} += {_entry(of, 'i', kind=kind)}"])
            lines += [each_by, *_indented(inner)]
    return lines


_Term = Callable[[View, View, View], tuple[str, str, str]]
"""Of the left, right and whole matrix: the entry that is added to, the factor from the left and that from the right."""


def _product(left: View, right: View, block: int, term: _Term, first: str | None) -> list[str]:
    """A product row by row, the innermost loop along rows of the right matrix, which lie together."""
    whole = View.whole(block, (left.shape[0], right.shape[1]))
    kept, factor, add = term(left, right, whole)
    lines = [] if first is None else _loops(whole.shape, "i", [f"{_entry(whole, 'i')} = {first}"])
    return [
        *lines,
        f"for i0 in range({left.shape[0]}):",
        f"    for k in range({left.shape[1]}):",
        f"        f = {factor}",
        f"        for i1 in range({right.shape[1]}):",
        f"            {kept} += f * {add}",
    ]


def _value(left: View, right: View, whole: View) -> tuple[str, str, str]:
    return _at(whole, ("i0", "i1")), _at(left, ("i0", "k")), _at(right, ("k", "i1"))


def _left_moves(kind: str, left: View, right: View, whole: View) -> tuple[str, str, str]:
    return _at(whole, ("i0", "i1"), kind), _at(left, ("i0", "k"), kind), _at(right, ("k", "i1"))


def _right_moves(kind: str, left: View, right: View, whole: View) -> tuple[str, str, str]:
    return _at(whole, ("i0", "i1"), kind), _at(left, ("i0", "k")), _at(right, ("k", "i1"), kind)


def _computed(program: Program, results: Sequence[Number], given: Names) -> tuple[list[str], dict[Number, str]]:
    """Lines that compute results of a small program, and how its numbers are called; `given` ones are known."""
    from ballfg.dynamics.compiled.translation.source import expression

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


def _entry(view: View, index: str, first: int = 0, kind: str = "a") -> str:
    """The entry of a view at the indices of its loops; the first loops are not its own."""
    return _at(view, [f"{index}{dim + first}" for dim in range(len(view.shape))], kind)


def _at(view: View, indices: Sequence[str], kind: str = "a") -> str:
    """An entry of an array, or (of another kind) of its derivative by number q."""
    terms = [i if s == 1 else f"{i} * {s}" for i, s in zip(indices, view.strides, strict=True) if s]
    if view.offset or not terms:
        terms.append(str(view.offset))
    place = " + ".join(terms)
    if kind != "a":
        return f"{kind}{view.block}[q, {place}]"
    return f"w[{place}]" if view.block is None else f"a{view.block}[{place}]"
