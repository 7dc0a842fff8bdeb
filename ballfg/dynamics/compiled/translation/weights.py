"""Collects the values that a traced function computes from its tables alone, once for all states, as weights."""

from collections.abc import Hashable
from dataclasses import dataclass, field
from math import prod
from typing import Any, Final

import torch
from torch.fx import Graph, GraphModule, Node

from ballfg.dynamics.compiled.translation.arrays import View
from ballfg.dynamics.compiled.translation.recipe import Recipe

IDLE: Final = frozenset({"memory_format", "pin_memory", "device", "layout"})
"""Arguments without influence on numbers in the memory of a computer."""
VIEWS: Final = (torch.ops.aten.view.default, torch.ops.aten._unsafe_view.default)
"""Operations that need contiguous numbers; `reshape` does the same without that."""


@dataclass(frozen=True)
class Known:
    """A tensor that does not depend on the vectors of a function."""

    node: Node  # where it stands in the graph
    example: Any  # its value for the tables that were traced
    varies: bool  # whether other tables give other values


@dataclass
class Weights:
    """The known tensors that a program takes, one behind another."""

    taken: dict[Node, View] = field(default_factory=dict)
    length: int = 0
    _first: dict[Hashable, Node] = field(default_factory=dict)
    _known: dict[Node, Node] = field(default_factory=dict)

    def take(self, known: Known) -> View:
        """Places of the numbers of a tensor among the weights; one that is computed twice lies there once.

        A matrix lies there transposed if that makes its rows longer, as quick products need it, or leaves them as long:
        torch's layers take transposed tables.
        """
        shape = tuple(known.example.shape)
        node = self._same(known.node)
        if node not in self.taken:
            tall = len(shape) == 2 and shape[0] >= shape[1]
            view = View.whole(None, shape[::-1] if tall else shape, self.length)
            self.taken[node] = view.permuted((1, 0)) if tall else view
            self.length += prod(shape)
        return self.taken[node]

    def _same(self, node: Node) -> Node:
        """The first node with the same operation on the same operands."""
        if node not in self._known:
            operands = torch.fx.node.map_arg((node.args, node.kwargs), lambda n: self._same(n).name)
            computed = (str(node.target), repr(operands)) if node.op == "call_function" else node
            self._known[node] = self._first.setdefault(computed, node)
        return self._known[node]

    def recipe(self, graph: GraphModule, vectors: int) -> Recipe | None:
        """The recipe of the weights from tables, which are placeholders after `vectors` vectors; None: no weights."""
        if not self.taken:
            return None
        needed, own, copies = self._needed(), Graph(), dict[Node, Node]()
        tables = [node for node in graph.graph.nodes if node.op == "placeholder"][vectors:]
        constants = [node for node in graph.graph.nodes if node.op == "get_attr" and node in needed]
        copies |= {node: own.placeholder(f"given_{k}") for k, node in enumerate([*tables, *constants])}
        for node in graph.graph.nodes:
            if node in needed and node.op == "call_function":
                copies[node] = made = own.node_copy(node, copies.__getitem__)
                made.kwargs = {name: value for name, value in made.kwargs.items() if name not in IDLE}
                made.target = torch.ops.aten.reshape.default if node.target in VIEWS else node.target
        for node, view in self.taken.items():
            if view.strides != View.whole(None, view.shape).strides:
                copies[node] = own.call_function(torch.ops.aten.t.default, (copies[node],))
        own.output([copies[node] for node in self.taken])
        held = [getattr(graph, str(node.target)).detach() for node in constants]
        plain = [(tensor.tolist(), str(tensor.dtype).removeprefix("torch.")) for tensor in held]
        return Recipe(own.python_code("self").src, plain)

    def _needed(self) -> set[Node]:
        needed, wanted = set[Node](), list(self.taken)
        while wanted:
            node = wanted.pop()
            if node not in needed:
                needed.add(node)
                wanted += node.all_input_nodes
        return needed
