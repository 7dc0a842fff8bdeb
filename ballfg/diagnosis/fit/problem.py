"""Defines a fit problem with its unknowns, priors and losses, and linearises its rows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Self

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.diagnosis.fit.effects import has_effect, with_effects
from ballfg.diagnosis.fit.free import OWN_AIR, Deviation, Unknowns, coefficients_of_all
from ballfg.diagnosis.fit.response import ArcResponse, FittedPath, fitted_path, responses
from ballfg.diagnosis.fit.sensitivity import Predicted, Sensitivity, predict, sensitivity
from ballfg.diagnosis.fit.stretches import Stretches
from ballfg.diagnosis.fit.system import System, by_track
from ballfg.dynamics import AnalyticModel, Coefficient
from ballfg.dynamics.effects.flight import Wind
from ballfg.dynamics.population import SOFT_SPEED, launch_axes as group_axes
from ballfg.dynamics.variation import Variation
from ballfg.factors.loss import Loss
from ballfg.state import SPIN, STATE_DIM, VELOCITY

POSITION_LOSS = Loss("huber", 3.0)  # Loss of a whitened position residual (three coordinates)
LABEL_LOSS = Loss("cauchy", 3.0)  # Loss of a whitened spin label: some labels contradict the flight
LAUNCHER_SPIN_SIGMA = 150.0  # rad/s, prior per axis, about zero, of the spin for a launcher setting of typical size


@dataclass(frozen=True)
class Noise:
    """Scale of the noise: factor on the stated position noise (3,), spin labels in rad/s, unlabelled spins (3,) rad/s.

    Unlabelled spins scatter about their launcher's mean, unequally along its axes forward, across and up.
    """

    position: Array = field(default_factory=lambda: np.ones(3))
    label: float = 20.0
    spin: Array = field(default_factory=lambda: np.full(3, 60.0))


@dataclass(frozen=True)
class Problem:
    """Data and the model that is fitted to them."""

    model: AnalyticModel  # With every effect that has a coefficient among `free`
    stretches: Stretches  # The data
    free: Mapping[str, Coefficient]
    """Coefficients to estimate, by parameter name, with their priors; deviations by their names."""
    shared: bool = True
    """True if coefficients and launcher are estimated, else only first states, as in an evaluation on other tracks."""
    deviations: Mapping[str, Deviation] = field(default_factory=dict)
    """The deviations among `free`, by name."""

    @property
    def declared(self) -> dict[str, float]:
        """Prior means of the coefficients to estimate: the model's own values, and zero deviations."""
        parameters = dict(self.model.named_parameters())
        return {name: float(parameters[name].detach()) if name in parameters else 0.0 for name in self.free}

    @property
    def centres(self) -> Array:
        """(q,) prior means, as `declared`."""
        return np.array(list(self.declared.values()))

    @property
    def precisions(self) -> Array:
        """(q,) of the priors of coefficients."""
        return np.array([c.sigma**-2 for c in self.free.values()])

    @property
    def launcher_precision(self) -> Array:
        """(s,) of the priors of launcher settings, each for all three axes."""
        typical = (self.stretches.settings**2).mean(axis=0)
        return np.asarray(np.where(typical > 0.0, typical, 1.0) / LAUNCHER_SPIN_SIGMA**2)

    @property
    def common_precision(self) -> Array:
        """(q + 3 s,) of the priors of all common columns: coefficients, then launcher settings."""
        return np.concatenate((self.precisions, np.repeat(self.launcher_precision, 3)))

    @cached_property
    def in_own_air(self) -> AnalyticModel:
        """The model with a wind, which every track may have of its own."""
        return self.model if has_effect(self.model, Wind.name) else with_effects(self.model, Wind())

    def by_stretch(self, values: Mapping[str, float], stretches: Stretches | None = None) -> dict[str, float | Array]:
        """Coefficients by parameter name: one number, or (n,) if deviations make them differ between n stretches.

        Args: values: of all unknowns, by name.  stretches: None: the problem's own.
        """
        found: dict[str, float | Array] = {n: value for n, value in values.items() if n not in self.deviations}
        parameters, declared = dict(self.model.named_parameters()), self.model.declared_coefficients()
        for name, deviation in self.deviations.items():
            own = found.get(deviation.coefficient, float(parameters[deviation.coefficient].detach()))
            found[deviation.coefficient] = own + values[name] * deviation.along(
                self.stretches if stretches is None else stretches
            )
        for name in {deviation.coefficient for deviation in self.deviations.values()}:
            found[name] = np.clip(found[name], declared[name].low, declared[name].high)
        return found


@dataclass(frozen=True)
class Robust:
    """Robust weights of samples (n, k) and of spins (n,), and the losses (n,) of stretches."""

    samples: Array
    spins: Array
    losses: Array


@dataclass(frozen=True)
class Fit:
    """Unknowns of a problem and their predicted samples; the result of a fit is this at the minimum."""

    problem: Problem
    unknowns: Unknowns
    noise: Noise
    predicted: Predicted

    @classmethod
    def at(cls, problem: Problem, unknowns: Unknowns, noise: Noise) -> Self:
        """The prediction at some unknowns."""
        model, values = _of_each(problem, unknowns)
        return cls(problem, unknowns, noise, predict(model, problem.stretches, unknowns.starts, values))

    @property
    def values(self) -> dict[str, float | Array]:
        """Fitted coefficients, as `Problem.by_stretch`, with what each stretch has of its own."""
        return _of_each(self.problem, self.unknowns)[1]

    @property
    def model(self) -> AnalyticModel:
        """The model of the motion, with a wind if stretches have their own."""
        return _of_each(self.problem, self.unknowns)[0]

    @property
    def limits(self) -> tuple[Array, Array]:
        """(q + 3 s,) the smallest and the largest step of the common unknowns, by the bounds of coefficients."""
        values = np.array([self.unknowns.values[name] for name in self.problem.free])
        low, high = (np.array([getattr(c, end) for c in self.problem.free.values()]) for end in ("low", "high"))
        endless = np.full(self.unknowns.launcher.size, np.inf)
        return np.concatenate((low - values, -endless)), np.concatenate((high - values, endless))

    def stepped(self, step: Array) -> Unknowns:
        """The unknowns after a step (q + 3 s,) of the common ones, coefficients within their bounds; starts stay."""
        unknowns, free = self.unknowns, self.problem.free
        values = {
            name: float(np.clip(unknowns.values[name] + change, c.low, c.high))
            for (name, c), change in zip(free.items(), step[: len(free)].tolist(), strict=True)
        }
        return replace(unknowns, values=values, launcher=unknowns.launcher + step[len(free) :].reshape(-1, 3))

    def within(self, own: Mapping[str, Array]) -> dict[str, Array]:
        """What coefficients of stretches differ by, as far as their bounds allow."""
        model = self.problem.in_own_air
        declared, values = model.declared_coefficients(), self.problem.by_stretch(self.unknowns.values)
        means = coefficients_of_all(model, own, values)
        return {n: np.clip(mean + own[n], declared[n].low, declared[n].high) - mean for n, mean in means.items()}

    def variations(self) -> dict[str, Variation]:
        """Coefficients that differ between tracks, as fitted, by parameter name."""
        parameters, found = dict(self.problem.model.named_parameters()), dict[str, Variation]()
        declared = self.problem.model.declared_coefficients()
        for unknown, deviation in self.problem.deviations.items():
            name = deviation.coefficient
            base = self.unknowns.values.get(name, float(parameters[name].detach()))
            value = float(np.clip(base + self.unknowns.values[unknown], declared[name].low, declared[name].high))
            known = found[name].values if name in found else {deviation.first: base} if deviation.first else {}
            found[name] = Variation(deviation.by, {**known, deviation.level: value}, deviation.line)
        return found

    @cached_property
    def sigmas(self) -> Array:
        """(n, k, 3) m, stated noise times its estimated scale; infinite for padding."""
        return np.asarray(self.problem.stretches.sigmas.numpy() * self.noise.position)

    @cached_property
    def whitened(self) -> Array:
        """(n, k, 3) position residuals over their noise; zero for padding."""
        return np.asarray((self.problem.stretches.positions.numpy() - self.predicted.positions) / self.sigmas)

    @cached_property
    def whitened_spins(self) -> Array:
        """(n, 3) whitened residual of each spin against its label or, without one, along the axes of its launch."""
        stretches, unknowns = self.problem.stretches, self.unknowns
        mean = (launch_axes(unknowns.starts) @ (stretches.settings @ unknowns.launcher)[..., None])[..., 0]
        away = scatter_axes(unknowns.starts) @ (mean - unknowns.starts[:, SPIN])[..., None]
        unlabelled = away[..., 0] / self.noise.spin
        with np.errstate(invalid="ignore"):
            about = (stretches.labels.numpy() - self.predicted.labels) / self.noise.label
        return np.where(stretches.labelled[:, None], about, unlabelled)

    @cached_property
    def robust(self) -> Robust:
        """Weights and losses: Huber's of positions, Cauchy's of labels."""
        with np.errstate(over="ignore"):  # the loss of a path far outside of the room is infinite
            length = np.linalg.norm(self.whitened, axis=-1)
            spin, labelled = np.linalg.norm(self.whitened_spins, axis=-1), self.problem.stretches.labelled
        spin_weight = np.where(labelled, LABEL_LOSS.weight(spin), 1.0)
        spin_loss = np.where(labelled, LABEL_LOSS.value(spin), 0.5 * spin**2)
        losses = POSITION_LOSS.value(length).sum(axis=-1) + spin_loss
        return Robust(POSITION_LOSS.weight(length), spin_weight, losses)

    @cached_property
    def cost(self) -> float:
        """Half the robust sum of squares, including priors; infinite if a stretch misses a contact."""
        problem, cost = self.problem, float(self.robust.losses.sum())
        values = np.array([self.unknowns.values[name] for name in problem.free])
        cost += 0.5 * float((problem.precisions * (values - problem.centres) ** 2).sum())
        cost += 0.5 * float((problem.launcher_precision[:, None] * self.unknowns.launcher**2).sum())
        return cost if np.isfinite(cost) else np.inf

    def weighted_residual(self, weights: Robust) -> Array:
        """(n, m) whitened residuals of positions and spins, with the roots of some weights."""
        positions = self.whitened * np.sqrt(weights.samples)[..., None]
        spins = self.whitened_spins * np.sqrt(weights.spins)[:, None]
        return np.concatenate((positions.reshape(len(spins), -1), spins), axis=1)

    def position_rows(self, derivative: Array, stretches: Index | slice = np.s_[:]) -> Array:
        """(m, 3 k, d) whitened, robustly weighted rows of derivatives (m, k, 3, d) of the positions of m stretches."""
        scale = np.sqrt(self.robust.samples[stretches])[..., None] / self.sigmas[stretches]
        return np.asarray((derivative * scale[..., None]).reshape(len(derivative), -1, derivative.shape[-1]))

    @cached_property
    def in_own_air(self) -> Sensitivity:
        """As `sensitivity`, and last by a wind of each stretch where none is free: `linearised` then needs no other."""
        return self.sensitivity([name for name in OWN_AIR if name not in self.problem.free])

    def sensitivity(self, further: Sequence[str] = ()) -> Sensitivity:
        """Derivatives of the samples by first states, by all of `Problem.free`, and by further coefficients.

        The derivative by a deviation is that by its coefficient, times the weight of each stretch.
        """
        problem, deviations = self.problem, self.problem.deviations
        if not problem.shared:  # first states only: columns of coefficients stay zero
            found = sensitivity(self.model, problem.stretches, self.unknowns.starts, self.values, ())
            none = [(0, 0)] * (found.labels.ndim - 1) + [(0, len(problem.free))]
            return Sensitivity(np.pad(found.positions, [(0, 0), *none]), np.pad(found.labels, none))
        behind = [deviations[name].coefficient if name in deviations else name for name in problem.free]
        names, model = list(dict.fromkeys([*behind, *further])), problem.in_own_air if further else self.model
        parameters = dict(model.named_parameters())
        known = {name: float(parameters[name].detach()) for name in names} | self.values
        found = sensitivity(model, problem.stretches, self.unknowns.starts, known, names)
        if not deviations:
            return found
        chosen = [*range(STATE_DIM), *(STATE_DIM + names.index(name) for name in (*behind, *further))]
        weights = np.ones((len(problem.stretches), len(chosen)))
        for place, name in enumerate(problem.free, start=STATE_DIM):
            if name in deviations:
                weights[:, place] = deviations[name].along(problem.stretches)
        return Sensitivity(
            found.positions[..., chosen] * weights[:, None, None], found.labels[..., chosen] * weights[:, None]
        )

    @cached_property
    def path(self) -> FittedPath:
        """The motion at the unknowns."""
        return fitted_path(self)

    @cached_property
    def arcs(self) -> list[ArcResponse]:
        """Responses of all arcs of the motion to forces and kicks, in order of time."""
        return list(responses(self))

    def __getstate__(self) -> dict[str, object]:
        """The fields alone: other processes compute again what they need of the rest, which is larger."""
        return {one.name: getattr(self, one.name) for one in fields(self)}

    @cached_property
    def gram(self) -> Array:
        """(t, q + 1, q + 1) inner products of the common columns on each of t tracks, the residual last."""
        return by_track(self.linearised.eliminated().gram, self.problem.stretches.track)

    @cached_property
    def linearised(self) -> System:
        """The whitened, robustly weighted rows; common columns are coefficients, then launcher settings."""
        stretches, unknowns, noise = self.problem.stretches, self.unknowns, self.noise
        derivative = self.__dict__.get("in_own_air") or self.sensitivity()
        derivative = derivative.first(STATE_DIM + len(self.problem.free))
        positions, labelled = self.position_rows(derivative.positions), stretches.labelled[:, None, None]
        spins, scale = np.zeros((len(stretches), 3, derivative.labels.shape[-1])), noise.spin[:, None]
        axes = scatter_axes(unknowns.starts)
        spins[..., SPIN] = axes / scale
        spins = np.where(labelled, derivative.labels / noise.label, spins) * np.sqrt(self.robust.spins)[:, None, None]
        along = (axes @ launch_axes(unknowns.starts))[:, :, None]
        towards = -along * stretches.settings[:, None, :, None] / scale[:, None]
        by_launcher = np.where(labelled, 0.0, towards.reshape(len(stretches), 3, -1))
        none = np.zeros((*positions.shape[:2], unknowns.launcher.size))
        by_launcher = np.concatenate((none, by_launcher), axis=1)
        rows = np.concatenate((positions, spins), axis=1)
        by_common = np.concatenate((rows[..., STATE_DIM:], by_launcher), axis=-1)
        used = stretches.used.numpy()
        return System(self.weighted_residual(self.robust), rows[..., :STATE_DIM], by_common, used)


def _of_each(problem: Problem, unknowns: Unknowns) -> tuple[AnalyticModel, dict[str, float | Array]]:
    """The model, and its coefficients by parameter name, one number or (n,)."""
    found, own = problem.by_stretch(unknowns.values), unknowns.own
    if not own:
        return problem.model, found
    model = problem.in_own_air if any(name in own for name in OWN_AIR) else problem.model
    means = coefficients_of_all(model, own, found)
    return model, found | {name: means[name] + own[name] for name in means}


def scatter_axes(starts: Array) -> Array:
    """(n, 3, 3) rows forward, across and up of launches (n, 9), orthonormal even where a ball starts straight up."""
    return np.stack([group_axes(velocity) for velocity in starts[:, VELOCITY]])


def launch_axes(starts: Array) -> Array:
    """(n, 3, 3) columns forward (horizontally), across (z x forward) and up of launches (n, 9)."""
    x, y = starts[:, VELOCITY.start], starts[:, VELOCITY.start + 1]
    length = np.sqrt(x**2 + y**2 + SOFT_SPEED**2)
    x, y, zero = x / length, y / length, np.zeros_like(x)
    forward, across, up = (x, y, zero), (-y, x, zero), (zero, zero, zero + 1.0)
    return np.stack([np.stack(axis, axis=-1) for axis in (forward, across, up)], axis=-1)
