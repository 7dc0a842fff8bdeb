"""Holds the arrays of a program: network layers and other tables that are too large to split into numbers.

Loops make an array from numbers of the program and from weights; the program reads its entries as numbers. Its
derivatives run forward, by the few numbers through which all inputs depend on those of the program, or backward.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import prod
from typing import Final

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from ballfg.dynamics.compiled.translation.program import Number, Operation, Program

INPUTS: Final = ("input",)  # Operations that give inputs, by which derivatives are taken
SMALL: Final = 12  # Largest number of entries in an array that is split into numbers


@dataclass(frozen=True)
class View:
    """An array: where its numbers lie, in a block or among the weights."""

    block: int | None  # its number; None for an array among the weights
    shape: tuple[int, ...]  # of the array
    strides: tuple[int, ...]  # how many numbers further the next entry along each dimension lies
    offset: int = 0  # of the first number

    @classmethod
    def whole(cls, block: int | None, shape: Sequence[int], offset: int = 0) -> "View":
        """An array whose numbers lie one behind another."""
        strides = tuple(prod(shape[i + 1 :]) for i in range(len(shape)))
        return cls(block, tuple(shape), strides, offset)

    @property
    def size(self) -> int:
        """Number of its entries."""
        return prod(self.shape)

    @property
    def places(self) -> list[int]:
        """Places of its entries, in the order of the array."""
        found = [self.offset]
        for length, stride in zip(self.shape, self.strides, strict=True):
            found = [place + k * stride for place in found for k in range(length)]
        return found

    def reshaped(self, shape: Sequence[int]) -> "View | None":
        """The same numbers in another shape; None if that needs a copy."""
        known = [n for n in shape if n != -1]
        full = tuple(self.size // prod(known) if n == -1 else n for n in shape)
        plain = View.whole(self.block, self.shape, self.offset)
        squeezed = [(n, s) for n, s in zip(self.shape, self.strides, strict=True) if n != 1]
        if squeezed != [(n, s) for n, s in zip(plain.shape, plain.strides, strict=True) if n != 1]:
            return None
        return View.whole(self.block, full, self.offset)

    def permuted(self, dims: Sequence[int]) -> "View":
        """With its dimensions in another order."""
        return replace(self, shape=tuple(self.shape[d] for d in dims), strides=tuple(self.strides[d] for d in dims))

    def swapped(self, a: int, b: int) -> "View":
        """With two dimensions exchanged."""
        dims = list(range(len(self.shape)))
        dims[a], dims[b] = dims[b], dims[a]
        return self.permuted(dims)

    def unsqueezed(self, dim: int) -> "View":
        """With a further dimension of length one."""
        at, (shape, strides) = dim % (len(self.shape) + 1), (self.shape, self.strides)
        return replace(self, shape=(*shape[:at], 1, *shape[at:]), strides=(*strides[:at], 0, *strides[at:]))

    def squeezed(self, dim: int) -> "View":
        """Without a dimension, if its length is one."""
        at = dim % len(self.shape)
        return self if self.shape[at] != 1 else self.permuted([d for d in range(len(self.shape)) if d != at])

    def broadcast(self, shape: Sequence[int]) -> "View":
        """Repeated to a larger shape."""
        missing = len(shape) - len(self.shape)
        own = ((1,) * missing + self.shape, (0,) * missing + self.strides)
        strides = tuple(0 if n == 1 else s for n, s in zip(*own, strict=True))
        return replace(self, shape=tuple(shape), strides=strides)


@dataclass(frozen=True)
class Load:
    """A block filled with numbers of the program."""

    numbers: tuple[Number, ...]


@dataclass(frozen=True)
class Each:
    """An elementwise operation on views of one shape, written as a small program.

    Attributes:
        program, inputs, result: the operation, its operands and its result.  operands: views, as many as inputs.
    """

    program: Program
    inputs: tuple[Number, ...]
    result: Number
    operands: tuple[View, ...]


@dataclass(frozen=True)
class Product:
    """A matrix product (m, k) (k, n), plus a view (m, n) where there is one."""

    left: View
    right: View
    plus: View | None


@dataclass(frozen=True)
class Total:
    """A sum over the first dimensions of a view, as many as are `summed`."""

    of: View
    summed: int


Making = Load | Each | Product | Total


def operands_of(making: Making) -> list[View]:
    """The operand views of a block."""
    match making:
        case Load():
            return []
        case Each():
            return list(making.operands)
        case Product():
            return [making.left, making.right, *([] if making.plus is None else [making.plus])]
        case Total():
            return [making.of]


@dataclass
class Arrays:
    """The blocks of a program."""

    program: Program  # that reads them
    makings: list[Making] = field(default_factory=list)  # how each is made
    sizes: list[int] = field(default_factory=list)  # of each
    asked: dict[int, list[int]] = field(default_factory=dict)
    """Places of a block that are read, where their derivatives run backward."""

    def make(self, making: Making, shape: Sequence[int]) -> View:
        """A new block of a shape."""
        self.makings.append(making)
        self.sizes.append(prod(shape))
        return View.whole(len(self.makings) - 1, shape)

    def sources(self, block: int) -> list[int]:
        """A block and all those from which it is made, in an order in which each comes after what it needs."""
        found, wanted = set[int](), [block]
        while wanted:
            current = wanted.pop()
            if current not in found:
                found.add(current)
                wanted += [v.block for v in operands_of(self.makings[current]) if v.block is not None]
        return sorted(found)

    def loaded(self, block: int) -> list[Number]:
        """The numbers of the program that a block depends on."""
        found: dict[Number, None] = {}
        for source in self.sources(block):
            making = self.makings[source]
            if isinstance(making, Load):
                found |= dict.fromkeys(making.numbers)
        return list(found)

    def read(self, view: View) -> list[Number]:
        """The numbers of an array, as numbers of the program.

        Their derivatives run forward by the fewest numbers through which the array depends on the inputs, or backward
        from the numbers that are read, where these are fewer.
        """
        assert view.block is not None
        loaded, places = self.loaded(view.block), view.places
        through = narrowest(self.program, loaded)
        if len(set(places)) < len(through):
            known = self.asked.setdefault(view.block, [])
            known += [place for place in dict.fromkeys(places) if place not in known]
            through = []
        operands = (*through, *loaded)
        return [
            self.program.place(Operation("read", operands, where=(view.block, place, len(through)))) for place in places
        ]


def narrowest(program: Program, numbers: Sequence[Number]) -> list[Number]:
    """The fewest numbers through which some numbers depend on the inputs of a program.

    They are a minimum cut of the graph of operations in which every number may be passed once: derivatives by three
    features of a state take half as long as those by its six coordinates.
    """
    needed = program.needed(numbers)
    places = {number: k for k, number in enumerate(needed)}
    n, endless = len(needed), len(needed) + 1
    source, sink = 2 * n, 2 * n + 1  # a number is entered at k, passed, and left at n + k
    edges = [(k, n + k, 1) for k in range(n)]
    for number, k in places.items():
        operation = program.operations[number]
        edges += [(n + places[o], k, endless) for o in set(operation.operands)]
        if operation.name in INPUTS:
            edges.append((source, k, endless))
    edges += [(n + places[number], sink, endless) for number in set(numbers)]
    starts, ends, room = np.array(edges, dtype=np.int32).T
    graph = csr_array((room, (starts, ends)), shape=(sink + 1, sink + 1))
    left = graph - maximum_flow(graph, source, sink).flow
    left.eliminate_zeros()
    reached = set(breadth_first_order(left, source, return_predecessors=False).tolist())
    return [number for number, k in places.items() if k in reached and n + k not in reached]
