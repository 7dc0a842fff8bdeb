"""Holds torch operations on tables, as source that a file can keep; they compute the weights of compiled functions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True)
class Recipe:
    """Operations on tables, in a form for files."""

    source: str  # of `forward(self, *tables, *constants)`, which gives all weights
    constants: Sequence[tuple[Any, str]]  # as nested lists, with their type

    @cached_property
    def _forward(self) -> Any:
        names: dict[str, Any] = {"torch": torch, "inf": math.inf, "nan": math.nan}
        exec(self.source, names)
        return names["forward"]

    def __call__(self, *tables: Tensor) -> Tensor:
        """All weights (k,)."""
        constants = [torch.tensor(numbers, dtype=getattr(torch, kind)) for numbers, kind in self.constants]
        with torch.no_grad():
            parts = self._forward(self, *tables, *constants)
            return torch.cat([part.detach().double().reshape(-1) for part in parts])
