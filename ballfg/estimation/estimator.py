"""Defines the interface of all estimators."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ballfg.checks import as_float, check_instance, is_number, shown
from ballfg.dynamics.compiled.kept_model import check_model
from ballfg.dynamics.nominal import ready_nominal
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.measurement.position_noise import noise_doubts
from ballfg.estimation.observations.observation import given
from ballfg.estimation.result import Estimate
from ballfg.estimation.segmentation.physics import physics_of
from ballfg.estimation.settings import Settings
from ballfg.factors.batch import FactorBatch
from ballfg.prediction.state import World
from ballfg.tracks import Ball, Track
from ballfg.tracks.checks import check_scale
from ballfg.tracks.doubts import doubts_about

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel

LEAST_CHECKED = 3  # Least number of samples for a check of a track's scale


class Estimator(ABC):
    """Turns a track into states.

    Args:
        model: the ball; of a `Ball`, its nominal model.
        surfaces: table and floor; for a number (m), a table of that height with the floor below it.
        settings: noise and priors; None: those of measured tracks (`Settings.for_measured`).

    Raises: ValueError: if the model has measurement effects and the estimator does not undo them, or if GTSAM is to
        solve an estimator without a factor graph. TypeError: an argument of another type.
    """

    name: ClassVar[str]
    undoes_measurement: ClassVar[bool] = False
    """True if it takes a model that does not measure plainly."""
    takes_one_view: ClassVar[bool] = False
    """True if it takes tracks that one camera saw."""
    has_graph: ClassVar[bool] = False
    """True if GTSAM can solve it (`Settings.solver`)."""

    def __init__(self, model: BallModel | Ball, surfaces: Surfaces | float, settings: Settings | None = None) -> None:
        model = ready_nominal(model) if isinstance(model, Ball) else model
        check_model(model, "Load one with load_model, or give the Ball.")
        table = Surfaces.table_tennis(as_float("surfaces", surfaces, "m")) if is_number(surfaces) else surfaces
        known: Surfaces = check_instance("surfaces", table, Surfaces, "Give the height of the table in m, or Surfaces.")
        settings = Settings.for_measured(model) if settings is None else settings
        check_instance("settings", settings, Settings, "Make them with Settings.for_measured(model).")
        settings = settings.renamed(model)
        if not (model.measures_plainly or self.undoes_measurement):
            raise ValueError(
                f"model must have no measurement effects for the estimator '{self.name}' by itself. "
                "Use make_estimator, which undoes them, or leave the model's section measurement empty."
            )
        if settings.solver == "gtsam" and not self.has_graph:
            raise ValueError(
                f"settings.solver must be 'ballfg' or None for the estimator '{self.name}', which has no factor graph; "
                "got 'gtsam'. Use the smoother or the online estimator."
            )
        if settings.group is not None and settings.spins is not None:
            model = model.for_group(settings.spins.by, settings.group)
        self.model = model
        self.surfaces = known
        self.settings = settings
        self.world = World(model, known, settings.process)

    def __repr__(self) -> str:
        effects = type(self.model).__name__
        noise = " / ".join(f"{1e3 * s:g}" for s in self.settings.position_noise)
        return f"{type(self).__name__}({effects}, {self.surfaces}, noise {noise} mm)"

    def of(self, track: Track) -> Estimator:
        """The estimator with the coefficients of a track; the same one if none differ between tracks."""
        return self

    @abstractmethod
    def estimate(self, track: Track, factors: Sequence[FactorBatch] = ()) -> Estimate:
        """The states of a track, one per stamp.

        The status says if a track is too short or no motion explains it.

        Args:
            track: stamps, positions, observations, labels.
            factors: further factors, each on one state of the track, by the index of its sample.
        Raises:
            TypeError: if track is not a `Track`.
            ValueError: if its numbers cannot be metres and seconds.
        """

    def in_sections(self, track: Track) -> Iterator[Estimate]:
        """The estimate of a track as consecutive parts, so that the caller need not hold all of a long one.

        By default one part, the whole track.

        Args: track: as for `estimate`.
        """
        yield self.estimate(track)

    def prepared(self, track: Track, factors: Sequence[FactorBatch] = ()) -> Track:
        """The track with further factors among its observations, after a check of its units.

        Raises:
            TypeError: if track is not a `Track`.
            ValueError: if its numbers cannot be metres and seconds, were changed to something other than numbers after
                construction, or a factor ties several states.
        """
        if not hasattr(track, "observations"):
            raise TypeError(
                f"track must be a Track; got {type(track).__name__}. Make one with Track(times, positions): (n,) s and "
                "(n, 3) m."
            )
        if not (np.isfinite(track.positions).all() and np.isfinite(track.times).all()):
            raise ValueError(
                f"track {shown(track.name)}: times and positions must be finite; they were changed after the track was "
                "made. Make a new one of the samples that are known."
            )
        if len(track) >= LEAST_CHECKED and not track.part:
            # those of a ball that one camera saw are a start of our own, which may lie anywhere along its rays
            stated = (np.zeros_like(track.positions), None) if track.one_view else (track.positions, track.sigmas)
            check_scale(f"track {shown(track.name)}", track.times, *stated, None)
        if not self.takes_one_view and track.one_view:
            raise ValueError(
                f"track {shown(track.name)} must be seen by two cameras for the estimator '{self.name}'; got one. "
                "Use the smoother."
            )
        return track.observed(*given(factors))

    def doubts(self, track: Track) -> tuple[str, ...]:
        """Signs that the track is no ball above these surfaces, or noisier than stated; for `Estimate.notes`."""
        levels, drag = self.surfaces.heights(), physics_of(self.model).drag
        about = doubts_about(track.times, track.positions, levels, self.model.radius, drag)
        return (*about, *noise_doubts(track, self.settings))
