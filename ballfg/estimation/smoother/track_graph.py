"""Gives the factor graph of a track as GTSAM's objects, for further factors and for GTSAM's solvers."""

from dataclasses import dataclass, replace
from typing import Final

import gtsam
import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.checks import check_instance, shown
from ballfg.dynamics.model import BallModel
from ballfg.estimation.result import Estimate, Status
from ballfg.estimation.smoother.problem import TrackProblem
from ballfg.estimation.smoother.settle import Solution
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.bridge import STATE_KEY, from_gtsam, nonlinear_graph, to_gtsam
from ballfg.factors.graph import Convergence, Minimum
from ballfg.factors.gtsam_solver import Marginals
from ballfg.tracks import Track

NEAR: Final = 0.1
"""Posterior standard deviations from the minimum at which an estimate counts as converged; GTSAM's default tolerances
leave about that distance."""


@dataclass(frozen=True, eq=False)
class TrackGraph:
    """The factor graph of a track, with the events found by the smoother.

    Symbols x and c belong to it. `symbol("x", i)` is the state at stamp i, a vector of 9 (position m, velocity m/s,
    spin rad/s); with a memory of the tracker, 3 errors of its positions (m) follow. `symbol("c", 0)` is the vector of
    the coefficients and of the observations' unknowns, if any.

    Attributes:
        factors: all factors of the track; `push_back` adds further ones.
        values: the smoother's estimate, as initial values; `insert` adds further variables.
        keys: (n,) GTSAM's indices (keys) of the states.
        times: (n,) s, their stamps.
        model: the ball, with its estimated coefficients after the state.
        coefficients: names of the numbers in `symbol("c", 0)`.
    """

    factors: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    keys: NDArray[np.int64]
    times: Array
    model: BallModel
    coefficients: tuple[str, ...]
    _smoother: Smoother
    _problem: TrackProblem
    _solution: Solution

    @classmethod
    def of(cls, smoother: Smoother, track: Track) -> "TrackGraph":
        """The graph of a track with the events of the smoother.

        Args: smoother: with model, surfaces and settings.  track: stamps, positions, observations.
        Raises: ValueError: a track without a graph, or as `Estimator.estimate`.
        """
        prepared = smoother.prepared(track)
        problem, solution = smoother.solved(prepared.since_first())
        if solution.minimum.step is None:
            raise ValueError(f"track {shown(track.name)}: {Status.FAILED.value}")
        return cls(
            nonlinear_graph(solution.graph)[0],
            to_gtsam(solution.minimum.values),
            STATE_KEY + np.arange(len(track)),
            track.times,
            problem.ball,
            (*smoother.settings.coefficients, *problem.unknowns.names),
            smoother,
            problem,
            solution,
        )

    def estimate(self, values: gtsam.Values) -> Estimate:
        """The estimate at values, with the marginals of all factors.

        Its states are the given ones, without a second look at the end of a track near a contact.

        Args: values: of all variables of the factors.
        Raises:
            TypeError: values that are none of GTSAM's.  ValueError: values without a variable, as of another track.
            RuntimeError: GTSAM's, if the factors leave a variable undetermined.
        """
        check_instance("values", values, gtsam.Values, "Give the result of an optimizer of the graph.")
        asked = set(self.factors.keyVector())
        if lacking := sorted(asked - set(values.keys())):
            named = ", ".join(map(gtsam.DefaultKeyFormatter, lacking[:3]))
            raise ValueError(
                f"values must hold every variable of the graph's {len(asked)}; {len(lacking)} are missing, such as "
                f"{named}. Give the result of an optimizer of this graph."
            )
        marginals, point = Marginals(self.factors.linearize(values), values), from_gtsam(values)
        reached = Convergence.CONVERGED if marginals.distance < NEAR else Convergence.TOO_MANY_ITERATIONS
        minimum = Minimum(point, self.factors.error(values), self._solution.minimum.step, reached, 0)
        solution = replace(self._solution, minimum=minimum)
        found = self._smoother.at_minimum(self._problem, solution, marginals.covariances())
        return found.dated(self.times)
