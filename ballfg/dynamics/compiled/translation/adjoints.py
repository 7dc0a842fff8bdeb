"""Writes numba source for reverse-mode derivatives of a few entries of an array by all its operands."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from ballfg.dynamics.compiled.translation.arrays import Arrays, Each, Load, Product, Total, View
from ballfg.dynamics.compiled.translation.loops import EACH_STATE, Entries, indented, is_all, loops, product, slopes


def carried_back(arrays: Arrays, block: int, places: Sequence[int], adjoint: Entries) -> list[str]:
    """Lines that compute derivatives of some places of a block by all entries of its operand blocks.

    The derivatives of place k by a block lie among the adjoints of that block, as its derivative number k.
    """
    ones = [f"    {adjoint.place(block, str(place), str(k))} = 1.0" for k, place in enumerate(places)]
    lines, back = [adjoint.empty(block, "zeros"), EACH_STATE, *ones], _Back(arrays, adjoint)
    for source in reversed(arrays.sources(block)):
        lines += back.to_operands(source)
    return lines


@dataclass
class _Back:
    """Adds the shares of blocks to the adjoints of their operands."""

    arrays: Arrays
    adjoint: Entries
    begun: set[int] = field(default_factory=set)  # blocks whose adjoints hold something

    def to_operands(self, block: int) -> list[str]:
        """Lines for all operands of a block."""
        making, adjoint, lines = self.arrays.makings[block], self.adjoint, list[str]()
        values = Entries(self.arrays)
        match making:
            case Load():
                pass
            case Each():
                whole = View.whole(block, making.operands[0].shape)
                body, called, blocks = slopes(making, block, values)
                for view, slope in blocks:
                    made, sign = self._begin(view, alone=all(v == view for v, _ in blocks if v.block == view.block))
                    lines += made
                    body.append(f"{adjoint.at(view)} {sign} {called[slope]} * {adjoint.at(whole)}")
                if blocks:
                    lines += self._each(whole.shape, body)
            case Product(left, right, plus):
                whole = View.whole(block, (left.shape[0], right.shape[1]))
                if plus is not None and plus.block is not None:
                    lines += self._share(plus, adjoint.at(whole))
                if left.block is not None:
                    lines += self._product(left, (whole, adjoint), (right.permuted((1, 0)), values))
                if right.block is not None:
                    lines += self._product(right, (left.permuted((1, 0)), values), (whole, adjoint))
            case Total(of, summed):
                lines += self._share(of, adjoint.at(View.whole(block, of.shape[summed:]), summed))
        return lines

    def _begin(self, view: View, *, alone: bool = True) -> tuple[list[str], str]:
        """Lines that make the adjoint of a view's block if there is none, and how the first share goes to the view.

        Args: alone: false if shares of the same loop go to other views of the block.
        """
        assert view.block is not None
        if view.block in self.begun:
            return [], "+="
        self.begun.add(view.block)
        if alone and is_all(self.arrays, view):
            return [self.adjoint.empty(view.block, "empty")], "="
        return [self.adjoint.empty(view.block, "zeros")], "+="

    def _share(self, view: View, share: str) -> list[str]:
        """Lines that add a number to each entry of a view."""
        lines, sign = self._begin(view)
        return [*lines, *self._each(view.shape, [f"{self.adjoint.at(view)} {sign} {share}"])]

    def _product(self, into: View, left: tuple[View, Entries], right: tuple[View, Entries]) -> list[str]:
        """Lines that add products to a view: by one call if its rows lie one behind another."""
        lines, sign = self._begin(into)
        if into == View.whole(into.block, into.shape, into.offset):
            return [*lines, *product((into, self.adjoint), left, right, anew=sign == "=")]
        (one, ones), (other, others) = left, right
        whole = (into.shape[0], into.shape[1], one.shape[1])  # i2 runs over what is summed
        factors = (
            ones.at(replace(one, shape=whole, strides=(one.strides[0], 0, one.strides[1]))),
            others.at(replace(other, shape=whole, strides=(0, other.strides[1], other.strides[0]))),
        )
        target = self.adjoint.at(replace(into, shape=whole, strides=(*into.strides, 0)))
        return [*lines, *self._each(whole, [f"{target} += {' * '.join(factors)}"])]

    def _each(self, shape: Sequence[int], body: Sequence[str]) -> list[str]:
        return [EACH_STATE, f"    for q in range({self.adjoint.count}):", *indented(loops(shape, body), 2)]
