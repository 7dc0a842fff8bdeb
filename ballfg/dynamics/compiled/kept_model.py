"""A kept model stands for a ball model whose machine code lies on disk, and makes the model only where it must.

Torch takes longer to import than the rest of an estimate. What an estimate asks of a usual ball are numbers, priors and
machine code; a process that has seen the model before left all of it in a note. Anything else that is asked of a kept
model, it takes from the model itself, which it then makes.
"""

from __future__ import annotations

import hashlib
import sys
import weakref
from collections.abc import Callable, Hashable, Mapping, Sequence
from copy import copy
from dataclasses import asdict, dataclass, field
from functools import cache, cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, cast

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import check_instance, check_path
from ballfg.dynamics.coefficient import THIN_SHELL, Coefficient
from ballfg.dynamics.compiled.build import Code, built, read_note, write_note
from ballfg.dynamics.compiled.places import NUMBERS, Numbers, numbers_of, stamp_of
from ballfg.dynamics.domain import Domain
from ballfg.dynamics.population import SpinPopulation
from ballfg.dynamics.variation import Variation, values_of_group, values_of_track
from ballfg.tracks.noise import TrackNoise

if TYPE_CHECKING:
    from ballfg.dynamics.analytic import AnalyticModel
    from ballfg.dynamics.compiled.translation.recipe import Recipe
    from ballfg.dynamics.model import BallModel
    from ballfg.tracks import Track

FUNCTIONS: Final = ("rates", "impact", "surface", "rolling")
MAPPINGS: Final = {"noise": TrackNoise.from_mapping, "spins": SpinPopulation.from_mapping, "domain": Domain}
"""Of the descriptions of a model that a note holds as mappings, how they are read."""


@dataclass(frozen=True)
class Function:
    """A compiled function of a state and some coefficients."""

    compute: Code
    """`compute(x, c, w, xt, ct, y, yt)`: n states x (n, 9), their coefficients c (n, p), weights w (k,), tangents xt
    (n, 9, d) and ct (n, p, d); writes the results y (n, m) and their tangents yt (n, m, d)."""
    names: tuple[str, ...]  # of the p coefficients that the function uses, as in `model.named_parameters()`
    size: int  # m
    weigh: Recipe | None = None  # computes the weights from a model's tables; None if there are none
    source: str = ""  # of `compute`; empty where torch computes
    calls: Mapping[str, str] = field(default_factory=dict)  # sources of the functions that it calls, by their names


@dataclass(frozen=True)
class CompiledModel:
    """The functions of a ball model."""

    rates: Function  # of the velocity, then of the spin, (6,)
    impact: Function  # state after an impact, (9,)
    surface: Function  # offset of surfaces above their declared heights in m, and their slopes along x and y, (3,)
    rolling: Function  # rates of a ball that rests on a surface, (6,)
    radius: float  # m, of the ball

    @cached_property
    def parts(self) -> tuple[Function, Function, Function, Function]:
        """Rates, impact, surface and rolling."""
        return self.rates, self.impact, self.surface, self.rolling

    @cached_property
    def addresses(self) -> tuple[int, ...]:
        """By which machine code takes them."""
        return tuple(part.compute.address for part in self.parts)

    @cached_property
    def _weighed(self) -> bool:
        """True if any of them has weights."""
        return any(part.weigh is not None for part in self.parts)

    def weights(self, model: BallModel) -> tuple[Array, ...]:
        """Weights of the `parts` from a model's present tables."""
        if not self._weighed:
            return (NONE,) * len(self.parts)
        tables = numbers_of(model).tables()
        now, known = stamp_of(tables), _weights.get(model)
        if known is None or known[0] != now:
            plain = [table.detach() for table in tables]
            found = tuple(NONE if p.weigh is None else p.weigh(*plain).numpy() for p in self.parts)
            known = _weights[model] = (now, tables, found)
        return known[2]


NONE: Final = np.zeros(0)  # The weights of a function without tables
_Weighed = tuple[Hashable, Sequence[Any], tuple[Array, ...]]
"""Stamp of a model's tables; these, kept so that no others get their place in memory and with it their stamp; the
weights of its functions that were computed from them."""
_weights: weakref.WeakKeyDictionary[BallModel, _Weighed] = weakref.WeakKeyDictionary()


class KeptModel:
    """What estimates ask of an analytic model without measurement effects; attributes and methods as of `BallModel`.

    Args: facts: as `keep` wrote them.  make: makes the model.

    Attributes:
        radius, inertia_factor, learned_from, noise, spins, domain, variations: as of an `AnalyticModel`.
        names: of the coefficients that travel with the state, as of an `AugmentedModel`.
        alone: the same model without them.
    """

    random: ClassVar[bool] = False
    trained: ClassVar[None] = None
    measuring: ClassVar[None] = None
    measures_plainly: ClassVar[bool] = True

    def __init__(self, facts: Mapping[str, Any], make: Callable[[], BallModel]) -> None:
        own = {"radius": facts["radius"], "inertia_factor": facts["inertia"], "learned_from": facts["learned_from"]}
        own |= {name: None if facts[name] is None else read(facts[name]) for name, read in MAPPINGS.items()}
        own["variations"] = {name: Variation.from_mapping(one) for name, one in facts["variations"].items()}
        vars(self).update(own, _facts=facts, _make=make, names=())
        self._has({name: np.float64(value) for name, value in facts["values"].items()})

    def _has(self, values: dict[str, np.float64]) -> None:
        """Takes the values of its coefficients."""
        vars(self).update(_values=values, alone=self)
        NUMBERS[cast("BallModel", self)] = Numbers(
            {name: (values, name) for name in values}, {}, (), [], (self.radius, self.inertia_factor)
        )

    @cached_property
    def whole(self) -> BallModel:
        """The model itself, whose numbers then count."""
        if self.alone is not self:
            from ballfg.dynamics.augmented import AugmentedModel

            return AugmentedModel(self.alone.whole, self.names)
        from ballfg.dynamics.model import with_values

        model = with_values(
            self._make(), {n: float(v) for n, v in self._values.items() if v != self._facts["values"][n]}
        )
        NUMBERS[cast("BallModel", self)] = numbers_of(model)
        return model

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self.whole, name, value)  # a change is one of the model
        vars(self)[name] = value

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # of protocols of Python, such as that of copies
            raise AttributeError(name)
        return getattr(self.whole, name)

    @property  # type: ignore[misc]
    def __class__(self) -> type:
        """That of the model for whoever has imported models: it counts as one wherever types are checked."""
        if "ballfg.dynamics.model" not in sys.modules:
            return KeptModel
        from ballfg.dynamics.analytic import AnalyticModel

        return AnalyticModel

    def __repr__(self) -> str:
        return repr(self.whole)

    def __reduce__(self) -> tuple[Any, ...]:
        if "whole" in vars(self.alone):
            return copy, (self.whole,)
        return _again, (self._facts, self._make, {n: float(v) for n, v in self._values.items()}, self.names)

    @cached_property
    def functions(self) -> CompiledModel:
        """Its machine code."""
        rates, impact, surface, rolling = (_function(self._facts[name]) for name in FUNCTIONS)
        return CompiledModel(rates, impact, surface, rolling, self.radius)

    @property
    def content(self) -> dict[str, Any] | None:
        """That of its file; None if its coefficients are others."""
        own = "whole" not in vars(self) and self.alone is self and self._values == self._facts["values"]
        return self._facts["content"] if own else None

    @property
    def in_flight(self) -> KeptModel:
        """Itself."""
        return self

    @property
    def states_position_noise(self) -> bool:
        """Whether its file states the noise of measured positions."""
        return self.noise is not None and self.noise.position is not None

    def declared_coefficients(self) -> dict[str, Coefficient]:
        """Declarations of its coefficients by name."""
        return dict(self._declared)

    @cached_property
    def _declared(self) -> dict[str, Coefficient]:
        return {name: Coefficient(**one) for name, one in self._facts["coefficients"].items()}

    def inside(self, states: object) -> None:
        """Unknown."""

    def for_track(self, track: Track) -> KeptModel:
        """The model with the coefficients of one track."""
        return self._changed(values_of_track(self.variations, track))

    def for_group(self, by: str, group: str) -> KeptModel:
        """The model with the coefficients of a group of tracks."""
        return self._changed(values_of_group(self.variations, by, group))

    def _changed(self, values: Mapping[str, float]) -> KeptModel:
        return _again(self._facts, self._make, {**self._values, **values}, self.names) if values else self

    def with_travelling(self, names: tuple[str, ...]) -> KeptModel:
        """The model with some coefficients read from the state."""
        other = object.__new__(KeptModel)
        vars(other).update(vars(self), names=names, alone=self)
        vars(other).pop("whole", None)
        return other


def _again(
    facts: Mapping[str, Any], make: Callable[[], BallModel], values: Mapping[str, float], names: tuple[str, ...]
) -> KeptModel:
    """A kept model with other values."""
    found = KeptModel(facts, make)
    found._has({name: np.float64(value) for name, value in values.items()})
    return found.with_travelling(names) if names else found


def _function(fact: Mapping[str, Any]) -> Function:
    """A function from its sources."""
    for source in fact["calls"].values():
        built(source)
    code = built(fact["source"], fact["calls"] or None)
    return Function(code, tuple(fact["names"]), fact["size"], None, fact["source"], fact["calls"])


def augmented(model: BallModel, names: Sequence[str]) -> BallModel:
    """The model with some coefficients read from the state, an `AugmentedModel`; the model itself for none."""
    if not names:
        return model
    if type(model) is KeptModel and numbers_of(model).scalars.keys() >= set(names):
        return cast("BallModel", model.with_travelling(tuple(names)))
    from ballfg.dynamics.augmented import AugmentedModel

    return AugmentedModel(whole(model), names)


def carried(model: BallModel) -> tuple[BallModel, tuple[str, ...]]:
    """The model that takes no coefficients from the state, and the names of those that this one takes from it."""
    if type(model) is KeptModel:
        return cast("BallModel", model.alone), model.names
    from ballfg.dynamics.augmented import AugmentedModel

    return (model.model, model.names) if isinstance(model, AugmentedModel) else (model, ())


def whole(model: BallModel) -> BallModel:
    """The model itself, for work that changes it."""
    return model.whole if type(model) is KeptModel else model


def content_of(model: BallModel) -> dict[str, Any]:
    """The content of the model file of an analytic model, as `model_to_dict`."""
    if type(model) is KeptModel and (stated := model.content) is not None:
        return stated
    from ballfg.dynamics.model_file import model_to_dict

    return model_to_dict(cast("AnalyticModel", model))


def check_model(model: object, remedy: str) -> None:
    """Refuses what is no ball model. Raises: TypeError: naming its type."""
    if type(model) is not KeptModel:
        from ballfg.dynamics.model import BallModel

        check_instance("model", model, BallModel, remedy)


def ready(about: Callable[[], str], make: Callable[[], BallModel]) -> BallModel:
    """A model from its note where one was kept and torch is not there yet; else the model itself.

    Args: about: everything that decides what `make` makes, apart from the source of ballfg.  make: may be pickled.
    """
    if "torch" in sys.modules:
        return make()
    before = about()
    facts = read_note(_key(before))
    if facts is not None:
        return cast("BallModel", KeptModel(facts, make))
    model = make()
    if about() == before:  # else its file has changed meanwhile
        keep(before, model)
    return model


def ready_file(
    path: Path, *, radius: float | None = None, inertia_factor: float = THIN_SHELL, room: str | None = None
) -> BallModel:
    """`load_model` for an estimate, which does not change the model: without torch where its machine code is kept."""
    path = check_path("path", path)
    make = partial(_loaded, path, radius, inertia_factor, room)
    return ready(partial(about_file, path, radius, inertia_factor), make) if path.is_file() else make()


def about_file(path: Path, radius: float | None, inertia_factor: float) -> str:
    """What decides which model a file gives a ball."""
    return f"file, {hashlib.sha256(path.read_bytes()).hexdigest()}, {radius!r}, {inertia_factor!r}"


def _loaded(path: Path, radius: float | None, inertia_factor: float, room: str | None) -> BallModel:
    from ballfg.dynamics.model_file import load_model

    return load_model(path, radius=radius, inertia_factor=inertia_factor, room=room)


def keep(about: str, model: BallModel) -> None:
    """Writes the note of a model for `ready`, if it is an analytic one that has machine code and measures plainly."""
    from ballfg.dynamics.analytic import AnalyticModel
    from ballfg.dynamics.compiled.functions import compiled, is_of_package
    from ballfg.dynamics.model_file import model_to_dict

    if type(model) is not AnalyticModel:
        return
    plain = model.trained is None and model.measures_plainly and not model.random and is_of_package(model)
    if not plain or numbers_of(model).arrays or (functions := compiled(model)) is None:
        return
    described = {name: getattr(model, name) for name in MAPPINGS}
    facts = {
        "radius": model.radius,
        "inertia": model.inertia_factor,
        "learned_from": model.learned_from,
        **{name: None if one is None else one.to_mapping() for name, one in described.items()},
        "content": model_to_dict(model),
        "variations": {name: one.to_mapping() for name, one in model.variations.items()},
        "values": dict(zip(numbers_of(model).scalars, numbers_of(model).values(), strict=True)),
        "coefficients": {name: asdict(one) for name, one in model.declared_coefficients().items()},
    }
    parts = zip(FUNCTIONS, functions.parts, strict=True)
    sources = {
        n: {"source": f.source, "calls": dict(f.calls), "names": list(f.names), "size": f.size} for n, f in parts
    }
    write_note(_key(about), facts | sources)


@cache
def _key(about: str) -> str:
    folder, own = Path(__file__).parents[1], hashlib.sha256()
    for file in sorted((*folder.rglob("*.py"), *folder.rglob("*.yaml"))):  # the known balls are YAML
        own.update(file.read_bytes())
    return f"kept model, {about}, {own.hexdigest()}"
