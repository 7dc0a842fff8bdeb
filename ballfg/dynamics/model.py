"""Defines the interface of every ball model, analytic or learned: rates of flight, impact, rolling, measurement."""

import functools
from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Final, Self, TypeVar

import torch
from torch import Tensor, nn

from ballfg.checks import as_float
from ballfg.dynamics.coefficient import THIN_SHELL, Coefficient
from ballfg.dynamics.domain import Domain
from ballfg.dynamics.measurement import Later
from ballfg.dynamics.motion.impact import slip_velocity
from ballfg.dynamics.variation import values_of_group, values_of_track
from ballfg.state import POSITION, SPIN, STANDARD_GRAVITY, VELOCITY, VZ, Z

if TYPE_CHECKING:
    from ballfg.dynamics.population import SpinPopulation
    from ballfg.dynamics.trained import Trained
    from ballfg.dynamics.variation import Variation
    from ballfg.tracks import Track
    from ballfg.tracks.noise import TrackNoise

BASE: Final = "base."  # Prefix of the names of the coefficients of the model that a learned one corrects

ROLLING_FRICTION: Final = 0.25  # Coulomb coefficient that turns a resting ball's slip into rolling
ROLLING_RESISTANCE: Final = 0.01  # Deceleration of a rolling ball divided by g
SOFT_SLIP: Final = 0.2
"""m/s. Slip below which rolling friction falls to zero linearly, so that the equations stay smooth and not stiff."""

Rates = tuple[Tensor, Tensor | None]

M = TypeVar("M", bound=nn.Module)

_SUBSTITUTED = "_substituted"
"""Attribute of a copy by `substitute`: names of the module's own parameters that were replaced by tensors."""


class BallModel(nn.Module, ABC):
    """A ball with a radius, its flight, its impacts, its rest on surfaces, and its measurement.

    States are (..., 9) float64 (see `ballfg.state`). Rates are a pair: acceleration (..., 3) m/s^2, and angular
    acceleration (..., 3) rad/s^2 or None where the spin is constant (a third of a Jacobian's cost is saved then).
    All methods are batched over leading dimensions and differentiable, in the state and in the parameters.

    Attributes:
        radius: m.
        inertia_factor: moment of inertia divided by m R^2.
        trained: the noise and the launcher that were learned together with the model; None if none were.
        noise: the scatter of tracks about the model; None if unknown.
        variations: coefficients that differ between tracks, by name as in `named_parameters()`.
        spins: the spins of groups of shots; None if unknown.
        domain: the speeds, spins and places of the tracks that it was fitted on; None if unknown.
        learned_from: m, radius of the ball whose tracks taught its networks or coefficients, if that is another ball;
            else None.
        random: True if the model draws random numbers, so that the same state has another future each time; machine
            code then uses its `in_flight`.

    Raises: ValueError: if the radius is not within 0.001 to 1 m, or the inertia factor not within 0 to 1.
    """

    random: ClassVar[bool] = False

    def __init__(self, radius: float, inertia_factor: float = THIN_SHELL) -> None:
        super().__init__()
        self.radius = as_float("radius", radius, "m")
        self.inertia_factor = as_float("inertia_factor", inertia_factor)
        if not 0.001 <= self.radius <= 1.0:
            raise ValueError(f"radius must be 0.001 to 1 m; got {self.radius:g}. Is it in millimetres?")
        if not 0.0 < self.inertia_factor <= 1.0:
            raise ValueError(
                f"inertia_factor must lie in (0, 1]; got {self.inertia_factor:g}. A thin shell has 2/3, a solid ball "
                "0.4."
            )
        self.trained: Trained | None = None
        self.noise: TrackNoise | None = None
        self.variations: Mapping[str, Variation] = {}
        self.spins: SpinPopulation | None = None
        self.domain: Domain | None = None
        self.learned_from: float | None = None

    def for_track(self, track: "Track") -> Self:
        """The model with the coefficients of one track; the model itself if none differ between tracks."""
        return with_values(self, values_of_track(self.variations, track))

    def for_group(self, by: str, group: str) -> Self:
        """The model with the coefficients of a group of tracks, such as a stream of one launcher's shots.

        Args: by: the label that names groups.  group: its value.
        """
        return with_values(self, values_of_group(self.variations, by, group))

    @property
    def in_flight(self) -> "BallModel":
        """The same motion without randomness; the model itself if it is not random."""
        return self

    @functools.cached_property
    def parameter_count(self) -> int:
        """Number of the model's parameters."""
        return sum(p.numel() for p in self.parameters())

    def declared_coefficients(self) -> dict[str, Coefficient]:
        """Declarations (unit, bounds, prior) of the model's scalar parameters, by name as in `named_parameters()`.

        Parameters without a declaration, such as a network's weights, are left out.
        """
        return {}

    @abstractmethod
    def rates(self, state: Tensor) -> Rates:
        """Acceleration (..., 3) m/s^2 and angular acceleration (..., 3) rad/s^2, or None, of states (..., 9)."""

    @abstractmethod
    def after_bounce(self, state: Tensor) -> Tensor:
        """State (..., 9) right after an impact on a surface, from the state (..., 9) before it; the position stays."""

    def surface_offset(self, state: Tensor) -> Tensor | float:
        """(...) m by which surfaces lie above their declared heights; zero by default."""
        return 0.0

    def surface_slope(self, state: Tensor) -> Tensor | None:
        """(2,) or (..., 2) dimensionless slope of the surfaces along x and y under states; None: horizontal."""
        return None

    def gap(self, state: Tensor, height: Tensor | float) -> Tensor:
        """(...) m from a surface declared at height (...) m up to the ball's lowest point; negative below it."""
        return state[..., Z] - height - self.surface_offset(state) - self.radius

    def gap_rate(self, state: Tensor) -> Tensor:
        """(...) m/s, the time derivative of the gap: vz, less what the surface rises under the moving ball."""
        slope = self.surface_slope(state)
        return state[..., VZ] if slope is None else state[..., VZ] - climb(slope, state[..., VELOCITY])

    def gap_acceleration(self, state: Tensor) -> Tensor:
        """(...) m/s^2, the second time derivative of the gap in free flight over a plane surface."""
        acceleration = self.rates(state)[0]
        slope = self.surface_slope(state)
        return acceleration[..., Z] if slope is None else acceleration[..., Z] - climb(slope, acceleration)

    def inside(self, state: Tensor) -> Tensor | None:
        """(...) weight of states (..., 9): 1 where a learned model was trained, 0 far from there; None: unknown."""
        return None

    def save(self, path: str | Path) -> None:
        """Writes a model file by `save_model`."""
        from ballfg.dynamics.model_file import save_model

        save_model(self, path)

    @property
    def measuring(self) -> "BallModel | None":
        """The model inside this one that says how the ball is measured; None: it is taken to be written as it is."""
        return None

    @property
    def measures_plainly(self) -> bool:
        """Whether positions, stamps and spin labels are taken to be written down as they are."""
        return self.measuring is None or self.measuring.measures_plainly

    @property
    def states_position_noise(self) -> bool:
        """Whether its file states the noise of measured positions."""
        return self.noise is not None and self.noise.position is not None

    def measured(self, states: Tensor, later: Later) -> Tensor:
        """(..., 3) m, measured positions before noise.

        Args: states: (..., 9) true states.  later: a delay (s, not negative) to the true states that much later.
        """
        return states[..., POSITION] if self.measuring is None else self.measuring.measured(states, later)

    def true_stamps(self, stamps: Tensor) -> Tensor:
        """(...) s of true time since the first stamp of a track, from the recorded time.

        Coefficients of shape (n, 1), one for each of n tracks, go with stamps of shape (..., n, 1).
        """
        return stamps if self.measuring is None else self.measuring.true_stamps(stamps)

    def stamps(self, times: Tensor) -> Tensor:
        """(...) s as written since the first stamp of a track, from true times (...) s; undoes `true_stamps`."""
        return times if self.measuring is None else self.measuring.stamps(times)

    def labelled(self, spin: Tensor) -> Tensor:
        """(..., 3) rad/s as a label says, before noise, from the true spin (..., 3) rad/s; affine in it."""
        return spin if self.measuring is None else self.measuring.labelled(spin)

    def roll(self, state: Tensor) -> Rates:
        """Rates of a ball that rests on a surface: (..., 3) m/s^2, vertically zero, and (..., 3) rad/s^2.

        The air's forces act in the plane; friction acts until the ball rolls, and rolling resistance slows it.
        """
        return self.on_ground(state, *self.rates(state))

    def on_ground(self, state: Tensor, air: Tensor, air_torque: Tensor | None) -> Rates:
        """What the ground makes of the rates in flight: `roll` from (..., 3) m/s^2 and (..., 3) rad/s^2, or None."""
        velocity, spin = state[..., VELOCITY], state[..., SPIN]
        slip = slip_velocity(velocity, spin, self.radius)
        friction = -ROLLING_FRICTION * STANDARD_GRAVITY * _soft_direction(slip)
        resistance = -ROLLING_RESISTANCE * STANDARD_GRAVITY * _soft_direction(velocity[..., :2])
        kick = friction / (self.inertia_factor * self.radius)
        turn = kick - resistance / self.radius  # the latter keeps a rolling ball rolling
        zero = torch.zeros_like(turn[..., 0])
        acceleration = torch.cat((air[..., :2] + friction + resistance, zero[..., None]), dim=-1)
        torque = torch.stack((turn[..., 1], -turn[..., 0], zero), dim=-1)
        return acceleration, torque if air_torque is None else torque + air_torque


def climb(slope: Tensor, motion: Tensor) -> Tensor:
    """(...) rise of a surface of slope (..., 2) along a motion (..., 3), in the motion's unit."""
    return (slope * motion[..., :2]).sum(-1)


def _soft_direction(vector: Tensor) -> Tensor:
    """The direction of (..., 2) vectors, with a length that falls smoothly to zero below `SOFT_SLIP`."""
    return vector / (vector.square().sum(-1, keepdim=True) + SOFT_SLIP**2).sqrt()


def substitute(module: M, values: Mapping[str, Tensor]) -> M:
    """A copy of a module with some parameters or buffers replaced by tensors; everything else is shared.

    Args:
        values: tensors by parameter name as in `named_parameters()`. A tensor of shape (n, 1) in place of a scalar
            gives each of n states in a batch (n, 9) its own value.
    Raises: KeyError: if the module has no parameter of that name.
    """
    clone = _shallow_copy(module)
    substituted = module.__dict__.get(_SUBSTITUTED, frozenset())
    children: dict[str, dict[str, Tensor]] = {}
    for name, value in values.items():
        head, _, rest = name.partition(".")
        if rest:
            children.setdefault(head, {})[rest] = value
        else:
            if head not in substituted and head not in module._buffers:
                del clone._parameters[head]
            clone.__dict__[head] = value
    for head, inner in children.items():
        child = module._modules[head]
        if child is None:
            raise KeyError(head)
        clone._modules[head] = substitute(child, inner)
    clone.__dict__[_SUBSTITUTED] = substituted | {name for name in values if "." not in name}
    return clone


def is_substituted(module: nn.Module) -> bool:
    """True if the module is a copy by `substitute`."""
    return any(_SUBSTITUTED in part.__dict__ for part in module.modules())


def with_values(module: M, values: Mapping[str, float]) -> M:
    """A copy of a module with other values of some scalar parameters, by name; the module itself for none."""
    for name, value in values.items():
        module = _with_value(module, name, value)
    return module


def _with_value(module: M, name: str, value: float) -> M:
    """A copy of a module with another value of one scalar parameter, which stays a parameter; the rest is shared."""
    clone = _shallow_copy(module)
    head, _, rest = name.partition(".")
    if rest:
        child = module._modules[head]
        assert child is not None
        clone._modules[head] = _with_value(child, rest, value)
    else:
        own = module._parameters[head]
        clone._parameters[head] = nn.Parameter(
            torch.tensor(value, dtype=torch.float64), requires_grad=own is not None and own.requires_grad
        )
    return clone


def take_rows(module: M, rows: Tensor, count: int) -> M:
    """The module for some rows of a batch: substituted parameters with a row each are cut to those rows.

    Args:
        module: for instance a `BallModel`; returned itself if nothing was substituted.
        rows: boolean mask (n,) or indices.  count: n, the size of the whole batch.
    """
    names = module.__dict__.get(_SUBSTITUTED)
    children = {name: child for name, child in module._modules.items() if child is not None}
    taken = {name: take_rows(child, rows, count) for name, child in children.items()}
    if names is None and all(taken[name] is child for name, child in children.items()):
        return module
    clone = _shallow_copy(module)
    clone._modules.update(taken)
    for name in names or ():
        value = module.__dict__[name]
        if value.dim() and value.shape[0] == count:
            clone.__dict__[name] = value[rows]
    return clone


def _shallow_copy(module: M) -> M:
    """A copy of a module with the same parts; cheaper than `copy.copy`, since estimators make one at each stage."""
    clone = object.__new__(type(module))
    own = clone.__dict__
    own.update(module.__dict__)
    own["_parameters"] = module._parameters.copy()
    own["_modules"] = module._modules.copy()
    return clone
