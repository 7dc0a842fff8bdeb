"""Where a model keeps its numbers, the coefficients and the tables of weights that machine code takes."""

import weakref
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from ballfg.dynamics.model import BallModel


@dataclass(frozen=True)
class Numbers:
    """Where a model keeps its numbers: looking for them takes longer than a flight.

    Attributes:
        scalars: by name, the dictionary and the key at which a coefficient lies.
        arrays: the same for parameters that are no scalars, and buffers: derivatives by them are left to torch.
    """

    scalars: Mapping[str, tuple[dict[str, Any], str]]
    arrays: Mapping[str, tuple[dict[str, Any], str]]

    def value(self, name: str) -> float:
        """A coefficient as it is now."""
        owner, key = self.scalars[name]
        return float(owner[key].item())

    def tables(self) -> list[Tensor]:
        """The arrays as they are now."""
        return [owner[key] for owner, key in self.arrays.values()]

    def stamp(self) -> Hashable:
        """Changes when a number does, as long as the `tables` of an earlier stamp are kept alive."""
        values = tuple(self.value(name) for name in self.scalars)
        return values, tuple((id(table), table._version, table.data_ptr()) for table in self.tables())


_numbers: weakref.WeakKeyDictionary[BallModel, Numbers] = weakref.WeakKeyDictionary()


def numbers_of(model: BallModel) -> Numbers:
    """Where a model keeps its numbers.

    Args: model: without substituted parameters.
    """
    if model not in _numbers:
        parameters, buffers = dict(model.named_parameters()), dict(model.named_buffers())
        places = {}
        for name in (*parameters, *buffers):
            path, _, key = name.rpartition(".")
            part = model.get_submodule(path)
            places[name] = (part._parameters if name in parameters else part._buffers, key)
        scalars = {name: places[name] for name, p in parameters.items() if not p.dim()}
        arrays = {name: place for name, place in places.items() if name not in scalars}
        _numbers[model] = Numbers(scalars, arrays)
    return _numbers[model]
