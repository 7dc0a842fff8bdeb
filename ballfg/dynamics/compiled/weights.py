"""What a traced function makes of its tables alone: torch computes it once for all states, and the program takes it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from math import prod
from typing import Any

import torch
from torch import Tensor
from torch.fx import Graph, GraphModule, Node

from ballfg.dynamics.compiled.arrays import View


@dataclass(frozen=True)
class Known:
    """A tensor that does not depend on the vectors of a function.

    Attributes:
        node: where it stands in the graph.
        example: its value for the tables that were traced.
        varies: whether other tables give other values.
    """

    node: Node
    example: Any
    varies: bool


@dataclass
class Weights:
    """The known tensors that a program takes, one behind another."""

    taken: dict[Node, int] = field(default_factory=dict)
    length: int = 0

    def take(self, known: Known) -> View:
        """Where the numbers of a tensor lie among the weights."""
        shape = tuple(known.example.shape)
        if known.node not in self.taken:
            self.taken[known.node] = self.length
            self.length += prod(shape)
        return View.whole(None, shape, self.taken[known.node])

    def function(self, graph: GraphModule) -> Callable[..., Tensor] | None:
        """The function of the tables that gives all weights (k,); None where there are none."""
        if not self.taken:
            return None
        needed: set[Node] = set()
        wanted = list(self.taken)
        while wanted:
            node = wanted.pop()
            if node not in needed:
                needed.add(node)
                wanted += node.all_input_nodes
        own, copies = Graph(), dict[Node, Node]()
        for node in graph.graph.nodes:
            if node.op == "placeholder" or node in needed:
                copies[node] = own.node_copy(node, copies.__getitem__)
        own.output(tuple(copies[node] for node in self.taken))
        made = GraphModule(graph, own)
        vectors = sum(node.op == "placeholder" for node in graph.graph.nodes)

        def compute(*tables: Tensor) -> Tensor:
            unused = [torch.zeros(0, dtype=torch.float64)] * (vectors - len(tables))
            with torch.no_grad():
                return torch.cat([part.detach().double().reshape(-1) for part in made(*unused, *tables)])

        return compute
