"""Compiles the functions of a ball model, rates, impact, surface and rolling, each with its tangents."""

import inspect
import sys
import threading
import warnings
import weakref
from collections.abc import Callable, Hashable
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Final

import numba
import numpy as np
import torch
from torch import Tensor, nn

from ballfg.arrays import Array
from ballfg.dynamics.compiled.build import built, digest, read_note, write_note
from ballfg.dynamics.compiled.flight import fly_together
from ballfg.dynamics.compiled.kept import source_stamp
from ballfg.dynamics.compiled.kept_model import NONE, CompiledModel, Function, KeptModel
from ballfg.dynamics.compiled.places import Numbers, numbers_of
from ballfg.dynamics.compiled.translation.recipe import Recipe
from ballfg.dynamics.model import BallModel, is_substituted, substitute
from ballfg.dynamics.motion.flight_step import step_jacobian
from ballfg.dynamics.motion.limits import MAX_STEP
from ballfg.dynamics.networks.architecture import Architecture
from ballfg.progress import doing
from ballfg.state import STATE_DIM

VALUES_AGREE: Final = 1e-12  # Largest relative difference between a compiled value and torch's
SLOPES_AGREE: Final = 1e-10  # Largest relative difference between a compiled derivative and torch's
VERSIONS: Final = f"torch {torch.__version__}, numba {numba.__version__}"
COMPARED: Final = 4  # Number of random states at which both are computed


_OF_TORCH: Final = frozenset(vars(nn.Module()))
"""Attributes of every module; its parameters, buffers and parts are compared by themselves."""
_BESIDE: Final = frozenset(
    {
        "trained",
        "noise",
        "variations",
        "measurement",
        "spins",
        "domain",
        "learned_from",
        "coefficients",
        "parameter_count",
    }
)
"""Attributes of a ball model and of its effects that do not belong to its motion: priors among them."""


class NotTheSameError(Exception):
    """Compiled code gives other values than torch."""


class NotComparableError(Exception):
    """A module that cannot be compared with another one."""


_by_model: weakref.WeakKeyDictionary[BallModel, tuple[Numbers, CompiledModel | None]] = weakref.WeakKeyDictionary()
_by_structure: dict[Hashable, CompiledModel | None] = {}
_LOOKING: Final = threading.RLock()  # threads that want the same functions wait for one of them


def compiled(model: BallModel) -> CompiledModel | None:
    """The functions of a model, with its parameters as arguments; None if one cannot be compiled.

    Args: model: without substituted parameters. After an exchange of a module it gets other functions.
    """
    if type(model) is KeptModel:
        return compiled(model.whole)
    known = _by_model.get(model)
    if known is not None and known[0] is numbers_of(model):
        return known[1]
    if model.random or is_substituted(model):
        return None
    with _LOOKING:
        try:
            if (key := _structure(model)) not in _by_structure:
                _by_structure[key] = _compiled(model, key)
            found = _by_structure[key]
        except NotComparableError:
            found = _compiled(model, None)
        _by_model[model] = numbers_of(model), found
    return found


def _structure(module: nn.Module) -> Hashable:
    """The structure that decides which functions a module computes, apart from its parameters; copies share it.

    Raises: NotComparableError: if the module has attributes that cannot be compared.
    """
    own = {name: _plain(value) for name, value in vars(module).items() if name not in _OF_TORCH | _BESIDE}
    parts = tuple((name, _structure(child)) for name, child in module.named_children() if name not in _BESIDE)
    buffers = tuple((name, tuple(b.shape)) for name, b in module.named_buffers(recurse=False))
    parameters = tuple((name, tuple(p.shape)) for name, p in module.named_parameters(recurse=False))
    return (
        type(module),  # and not its name: a cell of a notebook that runs again defines another class of that name
        tuple(sorted(own.items())),
        tuple(sorted(getattr(module, "tabled", ()))),
        parameters,
        buffers,
        parts,
    )


def _plain(value: object) -> Hashable:
    if isinstance(value, tuple):
        return tuple(_plain(part) for part in value)
    if isinstance(value, (int, float, str, bool, type(None))):
        return value
    if isinstance(value, Architecture):
        return repr(value)
    raise NotComparableError


def _compiled(model: BallModel, key: Hashable | None) -> CompiledModel | None:
    try:
        with doing("machine code for this model"):
            rates, impact, surface = (_function(model, part, key) for part in PARTS[:-1])
            made = CompiledModel(rates, impact, surface, _on_ground(model, rates), model.radius)
            _compare_steps_once(model, made, key)
        return made
    except ImportError:
        raise
    except Exception as error:  # a user's own effect may do anything, and torch runs it all the same
        warnings.warn(f"{type(model).__name__} runs in torch, and so more slowly: {error}", stacklevel=2)
        return None


def _rates(model: BallModel, state: Tensor) -> Tensor:
    return _together(*model.rates(state))


def _rolling(model: BallModel, state: Tensor) -> Tensor:
    return _together(*model.roll(state))


def _together(acceleration: Tensor, spin_rate: Tensor | None) -> Tensor:
    return torch.cat((acceleration, torch.zeros_like(acceleration) if spin_rate is None else spin_rate), dim=-1)


def _impact(model: BallModel, state: Tensor) -> Tensor:
    return model.after_bounce(state)


def _surface(model: BallModel, state: Tensor) -> Tensor:
    offset, slope = model.surface_offset(state), model.surface_slope(state)
    if not isinstance(offset, Tensor):
        offset = state.new_full(state.shape[:-1], offset)
    slope = state.new_zeros((*state.shape[:-1], 2)) if slope is None else slope.expand(*state.shape[:-1], 2)
    return torch.cat((offset.expand(state.shape[:-1]).unsqueeze(-1), slope), dim=-1)


ON_GROUND: Final = """\
def compute(x, c, w, xt, ct, y, yt):
    air, airt = np.empty((len(x), 6)), np.empty((len(x), 6, xt.shape[2]))
    rates(x, c, w, xt, ct, air, airt)
    ground(x, air, w, xt, airt, y, yt)
"""
"""Source of rolling."""
PARTS: Final = (_rates, _impact, _surface, _rolling)  # Functions of a model and of a state (9,)


def _function(model: BallModel, function: Callable[[BallModel, Tensor], Tensor], key: Hashable | None) -> Function:
    """A function, from disk if a model of this structure was traced before.

    What was compared with torch then is compared again where the notes' key does not hold all sources: for a class of a
    user, whose file may import anything.
    """
    known = _about(function.__name__, model, key)
    kept = None if known is None else read_note(known)
    if kept is not None:
        weigh = None if kept["weights"] is None else Recipe(**kept["weights"])
        made = Function(built(kept["source"]), tuple(kept["names"]), kept["size"], weigh, kept["source"])
        try:
            if not is_of_package(model):
                _compare(model, function, made)
        except NotTheSameError:  # its source has changed since
            pass
        else:
            return made
    made = _traced(model, function)
    _compare(model, function, made)
    if known is not None:
        weights = None if made.weigh is None else asdict(made.weigh)
        write_note(known, {"source": made.source, "names": made.names, "size": made.size, "weights": weights})
    return made


def _on_ground(model: BallModel, rates: Function) -> Function:
    """Rolling: the rates in flight, then what the ground makes of them, so that a network is compiled once."""
    own = type(model).on_ground is BallModel.on_ground
    about = f"{model.radius!r}, {model.inertia_factor!r}, {source_stamp(inspect.getfile(BallModel))}, {_generator()}"
    known = f"ground, {about}, {VERSIONS}"
    kept = read_note(known) if own else None
    if kept is None:
        from ballfg.dynamics.compiled.translation.source import function_source
        from ballfg.dynamics.compiled.translation.trace import trace

        traced = trace(lambda x, air: _together(*model.on_ground(x, air[:3], air[3:])), [STATE_DIM, rates.size], [])
        source = function_source(traced, *traced.inputs)
        if own:
            write_note(known, {"source": source})
    else:
        source = kept["source"]
    built(source)
    calls = {"rates": rates.source, "ground": source}
    made = Function(built(ON_GROUND, calls), rates.names, rates.size, rates.weigh, ON_GROUND, calls)
    if kept is None or not is_of_package(model):
        _compare(model, _rolling, made)
    return made


def _about(name: str, model: BallModel, key: Hashable | None) -> str | None:
    """The key of a note on a model of some structure; None if its parts have no files or cannot be compared."""
    files = None if key is None else _files_of(model)
    return None if files is None else f"{name}, {key}, {files}, {_generator()}, {VERSIONS}"


@cache
def _generator() -> str:
    """Hashes of the files that generate source, so that source of another version is never loaded."""
    folder = Path(__file__).parent
    files = [folder / name for name in ("build.py", "functions.py", "flight.py")]
    return ",".join(digest(file) for file in (*files, *sorted((folder / "translation").glob("*.py"))))


def _files_of(model: BallModel) -> str | None:
    """Hashes of the files that define the parts of a model, and of those of ballfg that they import.

    None if a part has no file.
    """
    found = set()
    for part in model.modules():
        file = getattr(sys.modules.get(type(part).__module__), "__file__", None)
        if file is None:
            return None
        found.add(source_stamp(file))
    return ",".join(sorted(found))


def is_of_package(model: BallModel) -> bool:
    """True if ballfg and torch define all parts of a model, and nobody has replaced a method of ballfg's since."""
    kinds = {type(part) for part in model.modules()}
    own = {kind for each in kinds for kind in each.__mro__ if kind.__module__.startswith("ballfg.")}
    methods = [
        (sys.modules[kind.__module__], getattr(f, "__code__", None)) for kind in own for f in vars(kind).values()
    ]
    as_written = all(code is None or code.co_filename == module.__file__ for module, code in methods)
    return as_written and all(kind.__module__.startswith(("ballfg.", "torch.nn.")) for kind in kinds)


def _traced(model: BallModel, function: Callable[[BallModel, Tensor], Tensor]) -> Function:
    """A newly traced function."""
    from ballfg.dynamics.compiled.translation.source import function_source
    from ballfg.dynamics.compiled.translation.trace import trace  # torch's tracer takes a second to import
    from ballfg.dynamics.networks.layers import MNN

    numbers = numbers_of(model)
    scalars, arrays, tables = list(numbers.scalars), list(numbers.arrays), [one.detach() for one in numbers.tables()]

    def of_vectors(state: Tensor, coefficients: Tensor, *given: Tensor) -> Tensor:
        values = {name: coefficients[i] for i, name in enumerate(scalars)}
        whole = substitute(model, values | dict(zip(arrays, given, strict=True)))
        for part in whole.modules():
            if isinstance(part, MNN):
                part.write_out()
        return function(whole, state)

    traced = trace(of_vectors, [STATE_DIM, len(scalars)], tables)
    state, coefficients = traced.inputs
    needed = set(traced.program.needed(traced.outputs))
    used = [(name, number) for name, number in zip(scalars, coefficients, strict=True) if number in needed]
    source = function_source(traced, state, [number for _, number in used])
    names = tuple(name for name, _ in used)
    return Function(built(source), names, len(traced.outputs), traced.weights, source)


def _compare(model: BallModel, function: Callable[[BallModel, Tensor], Tensor], made: Function) -> None:
    """Compares a compiled function with torch at a few states. Raises: NotTheSameError: if they differ."""
    rng, p = np.random.default_rng(0), len(made.names)
    parameters = dict(model.named_parameters())
    if not parameters.keys() >= set(made.names):
        raise NotTheSameError(f"compiled {function.__name__} takes coefficients that the model does not have")
    own = np.array([float(parameters[name].detach()) for name in made.names])
    weights = NONE if made.weigh is None else made.weigh(*(t.detach() for t in numbers_of(model).tables())).numpy()
    states = rng.normal(size=(COMPARED, STATE_DIM)) * np.repeat((1.0, 5.0, 100.0), 3)
    coefficients = own + 0.05 * rng.normal(size=(COMPARED, p))

    def of_both(x: Tensor, c: Tensor) -> Tensor:
        values = {name: c[i] for i, name in enumerate(made.names)}
        return function(substitute(model, values), x)

    moved = np.tile(np.eye(STATE_DIM + p), (COMPARED, 1, 1))
    given = (states, coefficients, weights, moved[:, :STATE_DIM].copy(), moved[:, STATE_DIM:].copy())
    y, yt = np.zeros((COMPARED, made.size)), np.zeros((COMPARED, made.size, STATE_DIM + p))
    made.compute(*given, y, yt)
    for k in range(COMPARED):
        x, c = torch.from_numpy(states[k]), torch.from_numpy(coefficients[k])
        right = of_both(x, c).detach()
        rows = torch.cat([j.reshape(made.size, -1) for j in torch.autograd.functional.jacobian(of_both, (x, c))], dim=1)
        _agree(f"{function.__name__} of {type(model).__name__}", (y[k], yt[k]), (right, rows))


def _compare_steps_once(model: BallModel, made: CompiledModel, key: Hashable | None) -> None:
    """Compares a step unless a model of the package with the same sources agreed before. Raises: NotTheSameError."""
    known = _about("steps", model, key) if is_of_package(model) else None
    if known is None or read_note(known) is None:
        _compare_steps(model, made)
        if known is not None:
            write_note(known, {"agree": True})


def _compare_steps(model: BallModel, made: CompiledModel) -> None:
    """Hold a step of compiled flight, and its Jacobian, against the definition in torch, at a few states.

    Raises: NotTheSameError: if they differ.
    """
    states = np.random.default_rng(0).normal(size=(COMPARED, STATE_DIM)) * np.repeat((1.0, 5.0, 100.0), 3)
    start = torch.tensor(states)
    right = step_jacobian(model, start, start.new_full((COMPARED, 1), MAX_STEP))
    moved, names = np.tile(np.eye(STATE_DIM), (COMPARED, 1, 1)), made.rates.names
    c = np.tile([numbers_of(model).value(name) for name in names], (COMPARED, 1)).reshape(COMPARED, len(names))
    given = (c, np.zeros((*c.shape, STATE_DIM)), made.weights(model)[0], np.full(COMPARED, MAX_STEP))
    fly_together(made.rates.compute.address, states, moved, *given, np.zeros((COMPARED, STATE_DIM)), 1)
    _agree(f"flight of {type(model).__name__}", (states, moved), right)


def _agree(name: str, got: tuple[Array, Array], right: tuple[Tensor, Tensor]) -> None:
    """Refuse values and derivatives that are not those of torch. Raises: NotTheSameError."""
    for own, tensor, limit in zip(got, right, (VALUES_AGREE, SLOPES_AGREE), strict=True):
        wanted = tensor.numpy()
        if not (np.abs(own - wanted) <= limit * np.maximum(1.0, np.abs(wanted))).all():
            raise NotTheSameError(f"compiled {name} differs from torch")
