"""Writes numba source for reverse-mode derivatives of a few entries of an array by all its operands."""

from collections.abc import Sequence
from dataclasses import replace

from ballfg.dynamics.compiled.translation.arrays import Arrays, Each, Load, Product, Total, View
from ballfg.dynamics.compiled.translation.loops import EACH_STATE, Entries, indented, loops, product, slopes


def carried_back(arrays: Arrays, block: int, places: Sequence[int], adjoint: Entries) -> list[str]:
    """Lines that compute derivatives of some places of a block by all entries of its operand blocks.

    The derivatives of place k by a block lie among the adjoints of that block, as its derivative number k.
    """
    sources = arrays.sources(block)
    lines = [adjoint.empty(source, "zeros") for source in sources]
    ones = [f"    {adjoint.place(block, str(place), str(k))} = 1.0" for k, place in enumerate(places)]
    lines += [EACH_STATE, *ones]
    for source in reversed(sources):
        lines += _to_operands(arrays, source, adjoint)
    return lines


def _to_operands(arrays: Arrays, block: int, adjoint: Entries) -> list[str]:
    """Lines that add a block's share to the adjoints of its operands."""
    making, values, lines = arrays.makings[block], Entries(arrays), list[str]()
    match making:
        case Load():
            pass
        case Each():
            whole, (body, called, blocks) = View.whole(block, making.operands[0].shape), slopes(making, block, values)
            body += [f"{adjoint.at(view)} += {called[slope]} * {adjoint.at(whole)}" for view, slope in blocks]
            if blocks:
                lines += _each(adjoint, whole.shape, body)
        case Product(left, right, plus):
            whole = View.whole(block, (left.shape[0], right.shape[1]))
            if plus is not None and plus.block is not None:
                lines += _each(adjoint, plus.shape, [f"{adjoint.at(plus)} += {adjoint.at(whole)}"])
            if left.block is not None:
                lines += _product(adjoint, left, (whole, adjoint), (right.permuted((1, 0)), values))
            if right.block is not None:
                lines += _product(adjoint, right, (left.permuted((1, 0)), values), (whole, adjoint))
        case Total(of, summed):
            whole = View.whole(block, of.shape[summed:])
            lines += _each(adjoint, of.shape, [f"{adjoint.at(of)} += {adjoint.at(whole, summed)}"])
    return lines


def _product(adjoint: Entries, into: View, left: tuple[View, Entries], right: tuple[View, Entries]) -> list[str]:
    """Lines that add products to a view: by one call if its rows lie one behind another."""
    if into == View.whole(into.block, into.shape, into.offset):
        return product((into, adjoint), left, right)
    (one, ones), (other, others) = left, right
    whole = (into.shape[0], into.shape[1], one.shape[1])  # i2 runs over what is summed
    factors = (
        ones.at(replace(one, shape=whole, strides=(one.strides[0], 0, one.strides[1]))),
        others.at(replace(other, shape=whole, strides=(0, other.strides[1], other.strides[0]))),
    )
    target = adjoint.at(replace(into, shape=whole, strides=(*into.strides, 0)))
    return _each(adjoint, whole, [f"{target} += {' * '.join(factors)}"])


def _each(adjoint: Entries, shape: Sequence[int], body: Sequence[str]) -> list[str]:
    return [EACH_STATE, f"    for q in range({adjoint.count}):", *indented(loops(shape, body), 2)]
