"""A measurement in the window of iSAM2 holds its factor and the last result of its torch batch."""

from collections import defaultdict
from collections.abc import Hashable, Sequence

import gtsam
import numpy as np

from ballfg.arrays import Array
from ballfg.checks import shown
from ballfg.dynamics.model import BallModel
from ballfg.estimation.observations.innovation import FilterInnovation
from ballfg.estimation.observations.observation import Context, refuse_unknowns
from ballfg.estimation.settings import Settings
from ballfg.factors.batch import FactorBatch, merge
from ballfg.factors.bridge import Bridge, checked
from ballfg.state import STATE_DIM
from ballfg.tracks import Track


class Measurement:
    """One measurement of a state.

    Args: batch: of one factor on a single state.

    Attributes: innovation: (dim,) whitened, against the prediction when it came in; NaN without a prediction.
    """

    def __init__(self, batch: FactorBatch) -> None:
        self.batch = batch
        self.bridge = Bridge(batch, on_miss="row")
        self.innovation = np.full(batch.dim, np.nan)

    def factor(self, state: int) -> gtsam.CustomFactor:
        """The factor on a state of the stream."""
        return self.bridge.factor(0, [state])

    def corrected(self, state: Array, covariance: Array) -> tuple[Array, Array]:
        """State (9,) and covariance (9, 9) after an extended Kalman filter's update with the measurement.

        A tracker's bias may follow the state; the measurement does not depend on it. A robust loss weights the update
        by the innovation, which is stored the first time.
        """
        found = FilterInnovation.of(self.batch, state, covariance)
        if np.isnan(self.innovation).any():
            self.innovation = found.whitened
        gain = np.linalg.solve(found.spread + found.R, found.H @ covariance).T
        return state - gain @ found.residual, covariance - gain @ found.H @ covariance


def prepare(measurements: Sequence[Measurement], states: Array) -> None:
    """Evaluates measurements at their states (k, 9), one call per kind, and stores the results for iSAM2's queries.

    Biases may follow the states.

    Raises: ValueError: if a residual is not finite: a ball is not in front of its camera, for instance.
    """
    groups: defaultdict[Hashable, list[int]] = defaultdict(list)
    for k, measurement in enumerate(measurements):
        groups[measurement.batch.group].append(k)
    for members in groups.values():
        batch = merge([measurements[k].batch for k in members])
        inputs = (np.ascontiguousarray(states[members, :STATE_DIM]),)
        residual, (jacobian,) = checked(batch, slice(None), inputs, *batch.compute(slice(None), inputs))
        for row, k in enumerate(members):
            measurements[k].bridge.keep(0, (inputs[0][row],), residual[row], (jacobian[row],))


def measurements_beside(
    track: Track, model: BallModel, settings: Settings, sigma: Array
) -> dict[str, list[tuple[int, Measurement]]]:
    """All measurements other than positions, by name of the observation: each with the number of its sample.

    Args: sigma: (n, 3) m, of the positions.
    Raises: ValueError: an observation of several states, or settings that give it unknowns.
    """
    refuse_unknowns(track.observations, settings, "online")
    context, found = Context(track, model, settings, sigma), {}
    for observation in track.observations:
        batch = observation.batch(context)
        if batch.variables.shape[1] > 1:
            raise ValueError(
                f"track {shown(track.name)}: the estimator 'online' takes observations of one state each; "
                f"'{observation.name}' looks at other variables too. Use the smoother."
            )
        found[observation.name] = [(k, Measurement(one)) for k, one in observation.single_rows(batch)]
    return found
