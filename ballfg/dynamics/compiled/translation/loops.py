"""Writes numba source for the arrays of a program: loops over many states that fill them, and their derivatives.

Array `k` of all states lies one behind another in `a<k>`: number i of state r at r * size + i. Derivatives by (or of)
`count` numbers lie in an array of another name, the q-th of state r at (r * count + q) * size + i.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from ballfg.dynamics.compiled.translation.arrays import Arrays, Each, Load, Making, Product, Total, View
from ballfg.dynamics.compiled.translation.program import Number, Program

EACH_STATE = "for r in range(n):"
INFIX: Final = {"add": "+", "sub": "-", "mul": "*", "div": "/", "le": "<=", "ge": ">=", "lt": "<", "gt": ">"}
CALLS: Final = {
    **{name: f"math.{name}" for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "tanh")},
    **{"abs": "abs", "minimum": "min", "maximum": "max"},
}


@dataclass(frozen=True)
class Entries:
    """Names of the entries of blocks: values, or derivatives of which every state has `count`."""

    arrays: Arrays  # all of them
    kind: str = "a"  # what the names of the blocks begin with
    count: int | None = None  # of derivatives; None for values

    def name(self, block: int | None) -> str:
        """Name of a block, or of the weights."""
        return "w" if block is None else f"{self.kind}{block}"

    def step(self, block: int | None) -> int:
        """Distance to the numbers of the next state, or of its next derivative; 0 for weights."""
        return 0 if block is None else self.arrays.sizes[block]

    def empty(self, block: int, how: str) -> str:
        """A line that makes a block: `how` is "empty" or "zeros"."""
        size = self.step(block) * (self.count or 1)
        return f"{self.name(block)} = np.{how}(n * {size})"

    def place(self, block: int | None, within: str, which: str = "q") -> str:
        """Entry `within` of a block of state r, or of the derivative `which` there."""
        if block is None:
            return f"w[{within}]"
        first = "r" if self.count is None else f"(r * {self.count} + {which})"
        return f"{self.name(block)}[{first} * {self.step(block)} + {within}]"

    def at(self, view: View, first: int = 0) -> str:
        """The entry of a view at the indices i0, i1, ... of its loops; the first loops are not its own."""
        indices = [f"i{dim + first}" for dim in range(len(view.shape))]
        terms = [i if s == 1 else f"{i} * {s}" for i, s in zip(indices, view.strides, strict=True) if s]
        if view.offset or not terms:
            terms.append(str(view.offset))
        return self.place(view.block, " + ".join(terms))


def filled(arrays: Arrays, block: int) -> list[str]:
    """Lines that fill a block from weights `w` and other blocks; the caller of a `Load` fills it with its numbers."""
    making, values = arrays.makings[block], Entries(arrays)
    lines = [values.empty(block, "zeros" if isinstance(making, Total) else "empty")]
    match making:
        case Load():
            return lines
        case Each() if _is_tanh(arrays, making):
            return [*lines, f"tanh_all({values.name(making.operands[0].block)}, {values.name(block)})"]
        case Each():
            whole = View.whole(block, making.operands[0].shape)
            body, called = computed(making.program, [making.result], given_names(making, values))
            body.append(f"{values.at(whole)} = {called[making.result]}")
        case Product(left, right, plus):
            whole = View.whole(block, (left.shape[0], right.shape[1]))
            lines += product((whole, values), (left, values), (right, values), anew=True)
            if plus is None:
                return lines
            body = [f"{values.at(whole)} += {values.at(plus)}"]
        case Total(of, summed):
            whole = View.whole(block, of.shape[summed:])
            body = [f"{values.at(whole, summed)} += {values.at(of)}"]
    return [*lines, EACH_STATE, *indented(loops(_shape(making), body))]


def moved(arrays: Arrays, block: int, moving: Entries) -> list[str]:
    """Lines that fill a block's derivatives, forward from those of its operand blocks."""
    making, values = arrays.makings[block], Entries(arrays)
    lines = [moving.empty(block, "empty" if isinstance(making, Each | Product) else "zeros")]
    match making:
        case Load():
            return lines
        case Each():
            whole, (body, called, blocks) = View.whole(block, making.operands[0].shape), slopes(making, block, values)
            terms = [f"{called[slope]} * {moving.at(view)}" for view, slope in blocks]
            body.append(f"{moving.at(whole)} = {' + '.join(terms) or '0.0'}")
        case Product(left, right, plus):
            whole = View.whole(block, (left.shape[0], right.shape[1]))
            if left.block is not None:
                lines += product((whole, moving), (left, moving), (right, values), anew=True)
            if right.block is not None:
                lines += product((whole, moving), (left, values), (right, moving), anew=left.block is None)
            if plus is None or plus.block is None:
                return lines
            body = [f"{moving.at(whole)} += {moving.at(plus)}"]
        case Total(of, summed):
            whole = View.whole(block, of.shape[summed:])
            body = [f"{moving.at(whole, summed)} += {moving.at(of)}"]
    return [*lines, EACH_STATE, f"    for q in range({moving.count}):", *indented(loops(_shape(making), body), 2)]


def product(
    whole: tuple[View, Entries], left: tuple[View, Entries], right: tuple[View, Entries], *, anew: bool
) -> list[str]:
    """Lines that add products of matrices (m, k) (k, n) to a block's own (m, n), whose rows lie one behind another.

    There is one for every state, or as many as it has derivatives if these are those of `whole`. Args: anew: the block
    holds nothing yet.
    """
    (target, into), parts = whole, (left, right)
    counts = {entries.count for view, entries in parts if view.block is not None}
    together = counts <= {into.count}  # else values of a state stand beside its derivatives
    many = into.count or 1
    given = [into.name(target.block), _first(target, into, together), str(into.step(target.block))]
    for view, entries in parts:
        still = not together and entries.count is None
        step = 0 if still else entries.step(view.block)
        given += [entries.name(view.block), _first(view, entries, together), str(step), *map(str, view.strides)]
    number = (f"n * {many}" if many > 1 else "n") if together else str(many)
    sizes = (left[0].shape[0], left[0].shape[1], right[0].shape[1])
    call = f"add_product({', '.join(given)}, {number}, {', '.join(map(str, sizes))}, {int(anew)})"
    return [call] if together else [EACH_STATE, f"    {call}"]


def _first(view: View, entries: Entries, together: bool) -> str:
    """Place of the first entry of a view: for all states, or for state r."""
    if together or view.block is None:
        return str(view.offset)
    return f"{view.offset} + r * {(entries.count or 1) * entries.step(view.block)}"


def given_names(making: Each, values: Entries) -> dict[Number, str]:
    """Names of the operands of an operation in its loops."""
    return {n: values.at(v) for n, v in zip(making.inputs, making.operands, strict=True)}


def slopes(making: Each, block: int, values: Entries) -> tuple[list[str], dict[Number, str], list[tuple[View, Number]]]:
    """Derivatives of an operation by those of its operands that are blocks: lines, names, operands and numbers."""
    given = given_names(making, values)
    given[making.result] = values.at(View.whole(block, making.operands[0].shape))  # computed already
    pairs = [(n, v) for n, v in zip(making.inputs, making.operands, strict=True) if v.block is not None]
    found = [(view, making.program.derivative(making.result, n)) for n, view in pairs]
    body, called = computed(making.program, [slope for _, slope in found], given)
    return body, called, found


def computed(
    program: Program, results: Sequence[Number], given: Mapping[Number, str]
) -> tuple[list[str], dict[Number, str]]:
    """Lines that compute results of a small program, and the names of its numbers; `given` names are known."""
    needed, wanted = set[Number](), list(results)
    while wanted:
        number = wanted.pop()
        if number not in needed and number not in given:
            needed.add(number)
            wanted += program.operations[number].operands
    names = {**given, **{n: f"e{n}" for n in needed}}
    return [f"{names[n]} = {expression(program, n, names, {})}" for n in sorted(needed)], names


def loops(shape: Sequence[int], body: Sequence[str]) -> list[str]:
    """Loops i0, i1, ... over all entries of a shape, the last dimension innermost."""
    lines = ["    " * depth + f"for i{depth} in range({length}):" for depth, length in enumerate(shape)]
    return [*lines, *indented(body, len(shape))]


def indented(lines: Sequence[str], depth: int = 1) -> list[str]:
    """Lines within so many blocks."""
    return ["    " * depth + line for line in lines]


def _shape(making: Making) -> tuple[int, ...]:
    """Shape of the loops of an elementwise operation, of a sum, or of what is added to a product."""
    if isinstance(making, Product):
        return making.left.shape[0], making.right.shape[1]
    assert isinstance(making, Each | Total)
    return making.of.shape if isinstance(making, Total) else making.operands[0].shape


def _is_tanh(arrays: Arrays, making: Each) -> bool:
    """True if an operation is the hyperbolic tangent of a whole block."""
    operation, operand = making.program.operations[making.result], making.operands[0]
    return operation.name == "tanh" and operation.operands == making.inputs and is_all(arrays, operand)


def is_all(arrays: Arrays, view: View) -> bool:
    """True if a view has all numbers of a block in their order."""
    return (
        view.block is not None and view == View.whole(view.block, view.shape) and view.size == arrays.sizes[view.block]
    )


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
