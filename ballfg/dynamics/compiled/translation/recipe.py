"""Records torch operations on tables in a file; they compute the weights of compiled functions."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import torch
from torch import Tensor

RESHAPES: Final = frozenset({"view", "_unsafe_view"})
"""Operations that need contiguous numbers; `reshape` does the same without that."""


@dataclass(frozen=True)
class Recipe:
    """Operations on tables, in a form for files.

    Values are numbered: tables first, then constants, then the result of each step.
    """

    constants: Sequence[tuple[Any, str]]  # as nested lists, with their type
    steps: Sequence[tuple[str, Any, Any]]
    """Name of the operation, arguments, further ones by name; {"value": k} stands for a value."""
    taken: Sequence[int]  # numbers of the values that are the weights

    def __call__(self, *tables: Tensor) -> Tensor:
        """All weights (k,)."""
        values: list[Any] = [*tables]
        values += [torch.tensor(numbers, dtype=getattr(torch, kind)) for numbers, kind in self.constants]
        with torch.no_grad():
            for name, args, kwargs in self.steps:
                values.append(_operation(name)(*_filled(args, values), **_filled(kwargs, values)))
            return torch.cat([values[k].detach().double().reshape(-1) for k in self.taken])


def _operation(name: str) -> Callable[..., Any]:
    if name == "getitem":
        return lambda parts, number: parts[number]
    packet, _, overload = name.partition(".")
    if packet in RESHAPES:
        packet, overload = "reshape", "default"
    found: Callable[..., Any] = getattr(getattr(torch.ops.aten, packet), overload)
    return found


def _filled(written: Any, values: Sequence[Any]) -> Any:
    if isinstance(written, list):
        return [_filled(part, values) for part in written]
    if isinstance(written, dict):
        if "value" in written:
            return values[written["value"]]
        if "dtype" in written:
            return getattr(torch, written["dtype"])
        return {name: _filled(part, values) for name, part in written.items()}
    return written
