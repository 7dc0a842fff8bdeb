"""Finds the coefficients and weights that a model passes to machine code, without a search at each call."""

from __future__ import annotations

import weakref
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter, methodcaller
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from torch import Tensor

    from ballfg.dynamics.model import BallModel


@dataclass(frozen=True)
class Numbers:
    """References to a model's numbers: searching for them takes longer than a flight."""

    scalars: Mapping[str, tuple[dict[str, Any], str]]  # by name, the dictionary and the key at which a coefficient lies
    arrays: Mapping[str, tuple[dict[str, Any], str]]
    """The same for parameters that are no scalars, `Effect.tabled` ones, and buffers: derivatives by them are left to
    torch."""
    held: Sequence[dict[str, Any]]
    """Of each module of the model, the dictionary of its sub-modules."""
    parts: Sequence[tuple[Any, ...]]  # What each of these dictionaries held
    ball: tuple[float, float]  # radius (m) and inertia factor

    def are_of(self, model: BallModel) -> bool:
        """True if a model still consists of the same modules, none of them exchanged."""
        return [*map(tuple, map(dict.values, self.held))] == self.parts and self.ball == (
            model.radius,
            model.inertia_factor,
        )

    def value(self, name: str) -> float:
        """Present value of a coefficient."""
        owner, key = self.scalars[name]
        return owner[key].item()

    def values(self) -> list[float]:
        """Present values of all coefficients, in the order of `scalars`."""
        return [owner[key].item() for owner, key in self.scalars.values()]

    def tables(self) -> list[Tensor]:
        """Present arrays."""
        return [owner[key] for owner, key in self.arrays.values()]

    def stamp(self) -> Hashable:
        """A number that changes with any value, as long as the `tables` of an earlier stamp are kept alive."""
        return self.ball, tuple(self.scalars), tuple(self.values()), stamp_of(self.tables())


_VERSION: Final = attrgetter("_version")
_ADDRESS: Final = methodcaller("data_ptr")


def stamp_of(tables: Sequence[Tensor]) -> Hashable:
    """A number that changes with any of the tables, as long as those of an earlier stamp are kept alive."""
    return tuple(map(id, tables)), tuple(map(_VERSION, tables)), tuple(map(_ADDRESS, tables))


NUMBERS: Final[weakref.WeakKeyDictionary[BallModel, Numbers]] = weakref.WeakKeyDictionary()


def numbers_of(model: BallModel) -> Numbers:
    """References to the numbers of a model. Args: model: without substituted parameters."""
    known = NUMBERS.get(model)
    if known is None or not known.are_of(model):
        parameters, buffers = dict(model.named_parameters()), dict(model.named_buffers())
        places = {}
        for name in (*parameters, *buffers):
            path, _, key = name.rpartition(".")
            part = model.get_submodule(path)
            places[name] = (part._parameters if name in parameters else part._buffers, key)
        tabled = {f"{path}.{name}" for path, part in model.named_modules() for name in getattr(part, "tabled", ())}
        scalars = {name: places[name] for name, p in parameters.items() if not p.dim() and name not in tabled}
        arrays = {name: place for name, place in places.items() if name not in scalars}
        held = [part._modules for part in model.modules()]
        parts = [tuple(modules.values()) for modules in held]
        known = NUMBERS[model] = Numbers(scalars, arrays, held, parts, (model.radius, model.inertia_factor))
    return known
