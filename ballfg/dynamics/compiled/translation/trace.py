"""Traces a torch function to a program by torch's own tracer.

Small tensors are split into numbers (`rules.py`), and so are results made from them. Results of large tensors, such as
the layers of a network, stay arrays. Torch computes values that depend on tables alone, such as
weights, once for all states (`weights.py`).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor
from torch.fx import GraphModule, Node
from torch.fx.experimental.proxy_tensor import make_fx

from ballfg.dynamics.compiled.translation import rules
from ballfg.dynamics.compiled.translation.arrays import SMALL, Arrays, Each, Load, Product, Total, View
from ballfg.dynamics.compiled.translation.program import Number, Operation, Program
from ballfg.dynamics.compiled.translation.recipe import Recipe
from ballfg.dynamics.compiled.translation.weights import Known, Weights


def each_of(arrays: Arrays, target: Any, args: Sequence[Any], kwargs: Mapping[str, Any]) -> View:
    """An operation of arrays number by number, by its rule for numbers."""
    views = [a for a in args if isinstance(a, View)]
    shape = np.broadcast_shapes(*(view.shape for view in views))
    program = Program()
    inputs = [program.input() for _ in views]
    numbers = iter(inputs)
    given = [np.array(next(numbers), dtype=object) if isinstance(a, View) else a for a in args]
    result = int(rules.EACH[target](rules.Rules(program), *given, **kwargs).item())
    operands = tuple(view.broadcast(shape) for view in views)
    return arrays.make(Each(program, tuple(inputs), result, operands), shape)


def _reshaped(arrays: Arrays, view: View, shape: Sequence[int]) -> View:
    same = view.reshaped(shape)
    if same is None:
        program = Program()
        number = program.input()
        same = arrays.make(Each(program, (number,), number, (view,)), view.shape).reshaped(shape)
    assert same is not None
    return same


def _product(arrays: Arrays, left: View, right: View, plus: View | None = None) -> View:
    shape = left.shape[0], right.shape[1]
    plus = None if plus is None else plus.broadcast(shape)
    if left.block is None and shape[1] == 1:  # rows of states times weights, so that many states are one product
        left, right, plus = right.permuted((1, 0)), left.permuted((1, 0)), plus and plus.permuted((1, 0))
    return arrays.make(Product(left, right, plus), shape)


def _linear(arrays: Arrays, plus: View, left: View, right: View, beta: float = 1, alpha: float = 1) -> View:
    if beta != 1 or alpha != 1:
        raise rules.UnknownOperationError("a matrix product with factors cannot be compiled")
    return _product(arrays, left, right, plus)


def _total(arrays: Arrays, view: View, dims: Sequence[int] | None = None, keep: bool = False, **_: Any) -> View:
    rank = len(view.shape)
    summed = [d % rank for d in dims] if dims else list(range(rank))
    left = [d for d in range(rank) if d not in summed]
    made = arrays.make(Total(view.permuted([*summed, *left]), len(summed)), [view.shape[d] for d in left])
    for dim in sorted(summed) if keep else ():
        made = made.unsqueezed(dim)
    return made


def _mean(arrays: Arrays, view: View, dims: Sequence[int] | None = None, keep: bool = False, **_: Any) -> View:
    total = _total(arrays, view, dims, keep)
    return each_of(arrays, rules.aten.mul.Scalar, [total, total.size / view.size], {})


ARRAY_RULES: Final[dict[Any, Callable[..., View]]] = {
    rules.aten.mm.default: _product,
    rules.aten.addmm.default: _linear,
    **dict.fromkeys((rules.aten.sum.dim_IntList, rules.aten.sum.default), _total),
    **dict.fromkeys((rules.aten.mean.dim, rules.aten.mean.default), _mean),
    **dict.fromkeys(rules.RESHAPES, _reshaped),
    rules.aten.unsqueeze.default: lambda _, view, dim: view.unsqueezed(dim),
    **dict.fromkeys(rules.SQUEEZES, lambda _, view, dim: view.squeezed(dim)),
    rules.aten.expand.default: lambda _, view, shape, **__: view.broadcast(_full(view, shape)),
    rules.aten.permute.default: lambda _, view, dims: view.permuted(dims),
    rules.aten.transpose.int: lambda _, view, a, b: view.swapped(a, b),
    rules.aten.t.default: lambda _, view: view.permuted((1, 0)) if len(view.shape) == 2 else view,
    **dict.fromkeys(rules.COPIES, lambda _, view, **__: view),
}
"""Rules of further operations by operation."""


def _full(view: View, shape: Sequence[int]) -> list[int]:
    missing = len(shape) - len(view.shape)
    return [view.shape[i - missing] if n == -1 else n for i, n in enumerate(shape)]


MOST_READ = 500  # Largest array that is split into numbers for an operation without an array rule


@dataclass(frozen=True)
class Traced:
    """A function as a program.

    Attributes:
        program, arrays: all of it.  inputs: of the program, vector by vector.  outputs: numbers of the program.
        weights: gives the weights (k,) that the program takes, from the function's tables; None: it takes none.
    """

    program: Program
    arrays: Arrays
    inputs: list[list[Number]]
    outputs: list[Number]
    weights: Recipe | None


def trace(function: Callable[..., Tensor], lengths: Sequence[int], tables: Sequence[Tensor] = ()) -> Traced:
    """The program of a function of vectors and of tables.

    Args:
        function: of float64 vectors and tables; its branches must not depend on their values.  lengths: of the vectors.
        tables: of any shape; no derivatives by them.
    Raises: UnknownOperationError: if no rule covers an operation of the function.
    """
    examples = [torch.linspace(0.5, 1.5, size, dtype=torch.float64) for size in lengths]
    with torch.no_grad():
        graph = make_fx(function)(*examples, *tables)
        tracing = _Tracing(graph)
        inputs = [[tracing.program.input() for _ in range(size)] for size in lengths]
        result = tracing.run([np.array(vector, dtype=object) for vector in inputs], tables)
    outputs = [int(n) for n in result.reshape(-1)]
    return Traced(tracing.program, tracing.arrays, inputs, outputs, tracing.weights.recipe(graph, len(lengths)))


@dataclass
class _Tracing:
    graph: GraphModule
    program: Program = field(default_factory=Program)
    weights: Weights = field(default_factory=Weights)

    def __post_init__(self) -> None:
        self.arrays, self.rules = Arrays(self.program), rules.Rules(self.program)

    def run(self, vectors: Sequence[rules.Numbers], tables: Sequence[Tensor]) -> rules.Numbers:
        """Operations in their order: the numbers of the result."""
        values: dict[Node, Any] = {}
        given = iter((*vectors, *tables))
        for node in self.graph.graph.nodes:
            if node.op == "placeholder":
                value = next(given)
                values[node] = value if isinstance(value, np.ndarray) else Known(node, value, varies=True)
            elif node.op == "get_attr":
                values[node] = Known(node, getattr(self.graph, node.target), varies=False)
            elif node.op == "output":
                return self._numbers(values[node.args[0]])
            else:
                values[node] = self._applied(node, values)
        raise rules.UnknownOperationError("a function without result")

    def _applied(self, node: Node, values: Mapping[Node, Any]) -> Any:
        inputs = [values[n] for n in node.all_input_nodes]
        assert callable(node.target)
        if inputs and all(isinstance(value, Known) for value in inputs):
            args, kwargs = (_mapped(a, lambda n: values[n].example) for a in (node.args, node.kwargs))
            example = node.target(*args, **kwargs)
            return Known(node, example, any(value.varies for value in inputs))
        args, kwargs = (_mapped(a, lambda n: self._operand(values[n])) for a in (node.args, node.kwargs))
        if any(isinstance(self._operand(value), View) for value in inputs):
            made = self._of_arrays(node.target, args, kwargs)
            if made is not None:
                return self._numbers(made) if made.block is not None and made.size <= SMALL else made
            args, kwargs = (_parts(a, self._numbers) for a in (args, kwargs))
        rule = rules.RULES.get(node.target)
        if rule is None:
            raise rules.UnknownOperationError(f"torch's {node.target} cannot be compiled")
        return rule(self.rules, *args, **kwargs)

    def _operand(self, value: Any) -> Any:
        """Numbers of a small tensor, an array of a large one; tables of whole numbers as they are."""
        if not isinstance(value, Known) or not isinstance(value.example, Tensor):
            return value
        tensor = value.example
        if not tensor.is_floating_point():
            return tensor
        if tensor.numel() > SMALL:
            return self.weights.take(value)
        return self._numbers(self.weights.take(value)) if value.varies else self.rules.constants(tensor)

    def _numbers(self, value: Any) -> Any:
        if isinstance(value, Known):
            value = self._operand(value)
        if not isinstance(value, View):
            return value
        if value.size > MOST_READ:
            raise rules.UnknownOperationError(f"{value.size} numbers cannot be taken apart")
        if value.block is None:
            found = [self.program.place(Operation("weight", where=(place,))) for place in value.places]
        else:
            found = self.arrays.read(value)
        return np.array(found, dtype=object).reshape(value.shape)

    def _of_arrays(self, target: Any, args: Sequence[Any], kwargs: Mapping[str, Any]) -> View | None:
        """The result of an operation on arrays; None where arrays do not have it."""
        given = [self._loaded(a) if target in rules.EACH or target in LOADS else a for a in args]
        if target in rules.EACH:
            return each_of(self.arrays, target, given, kwargs)
        rule = ARRAY_RULES.get(target)
        return None if rule is None else rule(self.arrays, *given, **kwargs)

    def _loaded(self, value: Any) -> Any:
        """Numbers as an array."""
        if not isinstance(value, np.ndarray):
            return value
        return self.arrays.make(Load(tuple(int(n) for n in value.reshape(-1))), value.shape)


LOADS = frozenset({torch.ops.aten.mm.default, torch.ops.aten.addmm.default})
"""Operations on arrays that may take numbers too."""


def _mapped(args: Any, function: Callable[[Node], Any]) -> Any:
    return torch.fx.node.map_arg(args, function)


def _parts(args: Any, function: Callable[[Any], Any]) -> Any:
    if isinstance(args, (list, tuple)):
        return type(args)(_parts(a, function) for a in args)
    if isinstance(args, dict):
        return {name: _parts(a, function) for name, a in args.items()}
    return function(args)
