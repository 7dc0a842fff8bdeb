"""Holds the noise of measurements and motion and the priors, which all estimators share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import (
    check_array,
    check_choice,
    check_flag,
    check_instance,
    check_number,
    check_range,
    shown,
    type_name,
)
from ballfg.dynamics.coefficient import coefficient_sigmas, todays_name, todays_names
from ballfg.dynamics.compiled.places import numbers_of
from ballfg.dynamics.population import SpinGroup, SpinPopulation
from ballfg.estimation.launcher import Launcher, SpinLabel, group_spin
from ballfg.factors.loss import Loss
from ballfg.factors.noise import ProcessNoise
from ballfg.tracks import Track
from ballfg.tracks.track import label_text, level_of

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel

Solver = Literal["ballfg", "gtsam"]
SOLVERS: Final[tuple[Solver, ...]] = get_args(Solver)


@dataclass(frozen=True)
class Settings:
    """Noise and priors, the same for all estimators, so that a comparison isolates the method.

    Raises: ValueError: a standard deviation that is not positive and finite, or beyond that of any measurement.
        TypeError: a field of another type.
    """

    position_noise: tuple[float, float, float] = (0.0015, 0.0015, 0.0015)
    """m, standard deviation of the white error of a measured x, y, z, for tracks without standard deviations of their
    own."""

    position_scale: float = 1.0
    """Factor on the standard deviations of all positions, including those of a track."""

    memory: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """m, standard deviation per axis of the tracker's error that lasts from sample to sample; zeros: no such error."""

    memory_time: float = 0.02
    """s, over which the correlation of that error falls to 1 / e."""

    stamp_jitter: float = 0.0
    """s, standard deviation of the error of a stamp: the true moment of a measurement is earlier or later by that."""

    process: ProcessNoise = field(default_factory=ProcessNoise)
    """Process noise of the ball's motion: per root second, per impact, per hit."""

    spin_prior: float = 60.0
    """rad/s, standard deviation per axis of the spin of a ball without a spin label, about zero."""

    spin_label_noise: float = 20.0
    """rad/s, standard deviation per axis of a spin label."""

    velocity_prior: float = 20.0
    """m/s, standard deviation per axis of the velocity at the start of a track, about zero."""

    coefficients: Mapping[str, float] = field(default_factory=dict)
    """Model parameters estimated for each track: prior standard deviation by parameter name. Empty: the model counts as
    exact."""

    loss: Loss = field(default_factory=lambda: Loss("huber", 3.0))
    """Loss on each measured position; `Loss("squared")` without outliers. Gross outliers are found and set aside
    beforehand; Huber's loss bounds the influence of a missed one and leaves good samples their full weight."""

    sighting_loss: Loss = field(default_factory=lambda: Loss("cauchy", 5.0))
    """Loss on each sighting of a camera, on the norm of two whitened pixels. Wrong candidates are not set aside
    beforehand; Cauchy's loss gives them little weight, and costs good sightings 7 % of theirs."""

    time_offsets: Mapping[str, float] = field(default_factory=dict)
    """s, prior standard deviation of the time offset by name of camera, if offsets are estimated with each track; the
    prior's mean is the camera's own. Leave out one camera: a common shift of all cannot be observed."""

    spin_loss: Loss = field(default_factory=lambda: Loss("huber", 2.0))
    """Loss on the spin prior: a strong spin is rare but possible."""

    label_loss: Loss = field(default_factory=lambda: Loss("cauchy", 3.0))
    """Loss on a spin label: some labels contradict the flight."""

    launcher: Launcher | None = None
    """Gives the spin of tracks without a spin label from their launcher settings."""

    spins: SpinPopulation | None = None
    """The spins of groups of shots, in place of `spin_prior` for the first spin of tracks without a spin label."""

    group: str | None = None
    """The group of tracks whose labels name none, for `spins`; None: unknown, so that its mixture counts."""

    one_view_acceleration: float = 0.5
    """m/s^1.5, least acceleration noise of a track that one camera saw. There the depth comes from the motion, so that
    an error of the ball's laws, which two cameras would correct, moves it. Chosen on 35 strokes seen from the side."""

    one_view_spin: tuple[float, float, float] = (40.0, 150.0, 40.0)
    """rad/s, standard deviations of the first spin of such a track about forward, across and up, in place of
    `spin_prior`: strokes make topspin and backspin, about the axis across. Not with `spins`."""

    find_events: bool = True
    """Look for hits, outliers and tracker shifts. False: the track is one undisturbed flight with contacts that the
    model explains."""

    solver: Solver | None = None
    """Solver of the factor graph: "ballfg", this package's own; "gtsam", GTSAM's Levenberg-Marquardt and marginals, and
    iSAM2 for the online estimator. None is "gtsam" for the class `Online`, else "ballfg"."""

    def __post_init__(self) -> None:
        self._check_types()
        for name, least in (("position_noise", "positive numbers"), ("memory", "numbers, zero or more,")):
            given = check_array(name, getattr(self, name), remedy="Give one number in m per axis.")
            right = given.shape == (3,) and np.isfinite(given).all() and (given >= 0.0).all()
            if not right or (name == "position_noise" and not given.all()):
                raise ValueError(f"{name} must be three {least} in m; got {getattr(self, name)}. Give one per axis.")
        check_number("position_scale", self.position_scale, above=0.0)
        check_number("memory_time", self.memory_time, "s", above=0.0)
        if max(self.memory) > MOST_NOISE:
            raise ValueError(f"memory must be at most {MOST_NOISE:g} m; got {max(self.memory):g}. Give it in m.")
        check_number("one_view_acceleration", self.one_view_acceleration, "m/s^1.5", above=0.0)
        check_range("stamp_jitter", self.stamp_jitter, 0.0, MOST_JITTER)
        for name in ("spin_prior", "spin_label_noise", "velocity_prior"):
            check_range(name, getattr(self, name), NARROWEST_PRIOR, WIDEST_PRIOR)
        for name, sigma in self.coefficients.items():
            check_range(f"coefficients[{shown(name)}]", sigma, NARROWEST_COEFFICIENT, WIDEST_COEFFICIENT)
        for name, sigma in self.time_offsets.items():
            check_range(f"time_offsets[{shown(name)}]", sigma, NARROWEST_COEFFICIENT, WIDEST_COEFFICIENT)

    def _check_types(self) -> None:
        """Refuses fields of another type.

        Raises: TypeError: naming the field.
        """
        for name, kind in _TYPES.items():
            check_instance(name, getattr(self, name), kind, "Give one, or leave it out.")
        check_flag("find_events", self.find_events)
        if self.solver is not None:
            check_choice("solver", self.solver, SOLVERS)
        if self.spins is not None:
            check_instance("spins", self.spins, SpinPopulation, "Load a model that has them, and take model.spins.")
        if self.group is not None:
            check_instance("group", self.group, str, "Give its name, or leave it out.")
            if self.spins is None:
                raise ValueError(
                    f"group must be None for a model without groups; got {shown(self.group)}. Use a model file with "
                    "the section populations, which ballfg-train writes with kind: calibrate and groups: LABEL; in "
                    "Python write Settings.for_measured(model, group=...) with it."
                )
            self.spins.check(self.group)
        if self.launcher is not None and not callable(getattr(self.launcher, "label", None)):
            got = f"{type_name(self.launcher)} {shown(self.launcher)}"
            raise TypeError(f"launcher must be a Launcher or None; got {got}. Read one from its file.")

    @classmethod
    def for_measured(cls, model: BallModel, **changes: Any) -> Settings:
        """Settings for measured tracks: the model's coefficients are estimated with each track within their priors.

        Args: model: gives the coefficients and their prior standard deviations, the noise that its file states, and the
            spins of its groups of shots.  changes: other fields; spins=None: without that noise and those groups.
        """
        usual: dict[str, Any] = {"coefficients": coefficient_sigmas(model), "process": MEASURED}
        if model.noise is None or changes.get("spins", model) is None:
            return cls(**(usual | {"spins": model.spins} | changes))
        from ballfg.estimation.noise.parameters import with_noise  # which needs this module

        return replace(with_noise(cls(**usual, spins=model.spins), model.noise), **changes)

    @property
    def has_memory(self) -> bool:
        """True if the tracker's errors last from sample to sample."""
        return max(self.memory) > 0.0

    @property
    def bias_sigmas(self) -> Array:
        """(3,) m, standard deviations of the lasting errors; a tiny one for an axis without any."""
        return np.maximum(self.memory, LEAST_BIAS)

    def for_track(self, track: Track) -> Settings:
        """The settings of a track: positions computed from other observations have no tracker's errors.

        A track that one camera saw has an acceleration noise and a spin prior of its own.
        """
        if not track.rough:
            return self
        plain = replace(self, memory=(0.0, 0.0, 0.0), stamp_jitter=0.0)
        if not track.one_view:
            return plain
        noise = max(self.process.acceleration, self.one_view_acceleration)
        strokes = SpinPopulation("stroke", {"any": SpinGroup((0.0, 0.0, 0.0), self.one_view_spin, 1)})
        process = replace(self.process, acceleration=noise)
        return replace(plain, process=process, spins=self.spins or strokes)

    def grouped(self, track: Track) -> Track:
        """The track with the label of its group, if the settings name the group of tracks without one."""
        if self.group is None or self.spins is None or self.spins.by in track.labels:
            return track
        return replace(track, labels={**track.labels, self.spins.by: self.group})

    def renamed(self, model: BallModel) -> Settings:
        """These settings with today's names of the model's coefficients."""
        earlier = [name for name in self.coefficients if todays_name(name) != name]
        if not earlier:
            return self
        known = {*numbers_of(model).scalars, *numbers_of(model).arrays}
        names = todays_names(self.coefficients, known)
        return replace(self, coefficients=dict(zip(names, self.coefficients.values(), strict=True)))

    def spin_label(self, track: Track) -> SpinLabel | None:
        """The spin known before a track: its label, else that of its launcher settings or its group, else None."""
        if track.spin_label is not None:
            return SpinLabel(track.spin_label, self.spin_label_noise)
        label = None if self.launcher is None else self.launcher.label(track)
        if label is not None or self.spins is None:
            return label
        own, spins = track.labels.get(self.spins.by), self.spins
        if own is not None and level_of(label_text(own), spins.groups) is None:
            spins = spins.with_unseen(self.spin_prior)
        return group_spin(spins, track, self.group)


_TYPES: dict[str, type] = {
    "process": ProcessNoise,
    "loss": Loss,
    "sighting_loss": Loss,
    "spin_loss": Loss,
    "label_loss": Loss,
    "coefficients": Mapping,
    "time_offsets": Mapping,
}

WIDEST_PRIOR = 1e5  # m/s or rad/s, widest prior of an unknown velocity or spin; a wider one adds nothing
NARROWEST_PRIOR = 1e-6  # m/s or rad/s. Narrowest prior; double precision cannot resolve less beside free states
WIDEST_COEFFICIENT = 1e9  # Widest prior of a coefficient, in its own unit, and of a time offset, s
NARROWEST_COEFFICIENT = 1e-12
"""Narrowest prior of a coefficient, in its own unit, and of a time offset, s: its square would be lost to rounding.
Leave a known coefficient out."""
MOST_JITTER = 1.0  # s. Over a second a ball goes and comes back: stamps with such an error carry no information

LEAST_BIAS = 1e-6  # m. Errors of this size are negligible; the linear algebra needs a number above zero

LEAST_NOISE = 1e-6
"""m. Nothing measures a ball to a micrometre; double precision cannot resolve less beside a free velocity."""
MOST_NOISE = 1e4  # m. Larger noise is cut to this: such a sample carries no information

MEASURED = ProcessNoise(contact_tangential=0.2, contact_spin=10.0)
"""Process noise on measured tracks: the effect of friction in a bounce is known to some 0.2 m/s only. Friction and
tangential restitution as coefficients of a track would be equivalent, but their kink hinders the minimisation."""


def spin_start(label: SpinLabel | None, settings: Settings) -> SpinLabel:
    """The spin at a start: that of the label, else the prior about zero."""
    return SpinLabel(np.zeros(3), settings.spin_prior, measured=False) if label is None else label


def sample_sigmas(settings: Settings, count: int, own: Array | None) -> Array:
    """(n, 3) m, writable: a track's own sigmas, else the settings', both scaled.

    They hold the white part of a position's error, within `LEAST_NOISE` and `MOST_NOISE`.
    """
    sigmas = np.broadcast_to(np.array(settings.position_noise), (count, 3)) if own is None else own
    return np.clip(settings.position_scale * sigmas, LEAST_NOISE, MOST_NOISE)


def stamp_covariance(settings: Settings, velocity: Array) -> Array:
    """(..., 3, 3) m^2, of the ball's displacement during the errors of stamps, at velocities (..., 3) m/s."""
    way = settings.stamp_jitter * velocity
    return np.asarray(way[..., :, None] * way[..., None, :])


def total_sigmas(settings: Settings, white: Array, velocities: Callable[[], Array]) -> Array:
    """Standard deviations of whole position errors: the white part, the lasting part, and that of the stamps.

    Args:
        settings: with memory and jitter.  white: (n, 3) m, of the white part.
        velocities: gives (n, 3) m/s, of the ball; asked for only where stamps jitter.
    Returns: (n, 3) m.
    """
    if not settings.has_memory and settings.stamp_jitter == 0.0:
        return white
    variance = white**2 + np.square(settings.memory)
    if settings.stamp_jitter:
        variance += (settings.stamp_jitter * velocities()) ** 2
    return np.asarray(np.sqrt(variance))
