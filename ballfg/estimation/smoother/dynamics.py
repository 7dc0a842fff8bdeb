"""Makes the dynamics factors of a track, one per linked interval, for any arrangement of events."""

from __future__ import annotations

from collections import defaultdict
from functools import cached_property

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.limits import steps_over_each
from ballfg.estimation.segmentation.result import Segmentation
from ballfg.estimation.smoother.motion import Motion, eventful_motions, kicks_of
from ballfg.factors.dynamics import ContactFactors, DynamicsFactors, FlightFactors, RestFactors
from ballfg.factors.noise import Kicks, ProcessNoise


class TrackDynamics:
    """Makes the dynamics factors of one track. Those of free flight are made once, for all arrangements.

    Args: times: (n,) s.  model: the ball, with the estimated coefficients.  noise: of its motion.
    """

    def __init__(self, times: Array, model: BallModel, noise: ProcessNoise) -> None:
        self.times, self.model, self.noise = times, model, noise
        self.dt = np.diff(times)
        self._steps = steps_over_each(self.dt)

    @cached_property
    def _flights(self) -> dict[int, FlightFactors]:
        """A flight over every interval, in batches of those with the same number of integration steps."""
        found = {}
        for steps in np.unique(self._steps).tolist():
            rows = np.flatnonzero(self._steps == steps)
            found[steps] = FlightFactors(self.model, rows, self.dt[rows], self.noise.flight_along_one(self.dt[rows]))
        return found

    def factors(self, events: Segmentation) -> list[DynamicsFactors]:
        """One factor per linked interval, in batches that share a motion and a number of integration steps.

        Args: events: with contacts in the wanted intervals.
        """
        motions = eventful_motions(events, self.times)
        flying = np.ones(len(self.dt), dtype=bool)
        groups: defaultdict[tuple[str, int], list[int]] = defaultdict(list)
        for i, motion in motions.items():
            if motion.linked and motion.heights:
                groups["contact", len(motion.heights)].append(i)
            elif motion.linked and motion.rest is not None:
                groups["rest", 0].append(i)
            flying[i] = motion.linked and not motion.heights and motion.rest is None
        hit = np.array([i for i, motion in motions.items() if motion.hit], dtype=np.int64)
        found: list[DynamicsFactors] = [self._flown(steps, flying, hit) for steps in self._flights]
        for (sort, _), rows in groups.items():
            made = self._contacts if sort == "contact" else self._rests
            found.append(made(np.array(rows), [motions[i] for i in rows]))
        return sorted((batch for batch in found if len(batch)), key=lambda batch: int(batch.variables[0, 0]))

    def _flown(self, steps: int, flying: Array, hit: Index) -> FlightFactors:
        """Flights in some of the intervals; for `hit` ones the process noise contains a hit."""
        flights = self._flights[steps]
        intervals = flights.variables[:, 0]
        kept = flying[intervals]
        flights = flights if kept.all() else flights.select(np.flatnonzero(kept))
        struck = np.flatnonzero(np.isin(flights.variables[:, 0], hit))
        return flights.with_hits(struck, self.noise) if len(struck) else flights

    def _contacts(self, rows: Index, motions: list[Motion]) -> ContactFactors:
        heights, kicks, covariance = np.array([m.heights for m in motions]), *self._kicked(rows, motions)
        return ContactFactors(self.model, rows, self.dt[rows], covariance, heights, kicks)

    def _rests(self, rows: Index, motions: list[Motion]) -> RestFactors:
        heights, kicks, covariance = np.array([m.rest for m in motions]), *self._kicked(rows, motions)
        return RestFactors(self.model, rows, self.dt[rows], covariance, heights, kicks)

    def _kicked(self, rows: Index, motions: list[Motion]) -> tuple[Kicks, Array]:
        """Contacts and hits of intervals with equal numbers of contacts, and their process noise."""
        dt = self.dt[rows]
        kicks = kicks_of(motions, dt)
        return kicks, self.noise.flight(dt) + self.noise.kicks(dt, kicks)
