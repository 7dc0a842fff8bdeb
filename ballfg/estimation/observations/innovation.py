"""Computes whitened innovations: a filter's against its prediction, a smoother's against all other measurements."""

from dataclasses import dataclass

import numpy as np

from ballfg.arrays import Array
from ballfg.factors.batch import FactorBatch, Rows
from ballfg.factors.linear.covariance import Covariances
from ballfg.factors.linear.definite import definite, joint_covariance, variances_positive, whitened
from ballfg.factors.linear.step import weighted
from ballfg.state import POSITION, STATE_DIM

LEAST_INFORMATION = 1e-6  # Least share of the posterior's information that the other measurements get
LEAST_JUDGED = 20  # Least number of measurements whose scatter is compared with what they state


@dataclass(frozen=True)
class FilterInnovation:
    """One factor on a filter's predicted state, linearised there, as the input of its update.

    To second order: within the prediction's spread a measurement such as a speed is no linear function of the state.
    What its curvature adds to mean and covariance counts too (Athans, Wishner, Bertolini 1968), so that a measurement
    counts little where it is far from linear.

    Attributes:
        residual: (r,) whitened, its mean.  H: (r, d) whitened, per unit of the filter's state.
        R: (r, r) noise of the whitened residual: one and the part of the curvature, divided by the weight that a robust
            loss gives the innovation.
        spread: (r, r) H P H^T, the covariance that the prediction adds to it.
        whitened: (r,) the innovation divided by the root of its covariance before the loss.
    """

    residual: Array
    H: Array
    R: Array
    spread: Array
    whitened: Array

    @classmethod
    def of(cls, factor: FactorBatch, mean: Array, covariance: Array, biases: int = 0) -> "FilterInnovation":
        """The innovation of a batch of one factor on the state, and perhaps on the coefficients behind it.

        Args:
            mean: (d,) m, m/s, rad/s, then the coefficients in their own units, then the tracker's biases in m.
            covariance: (d, d) in the squares of these units.  biases: their number; the factor does not see them.
        """
        own = slice(STATE_DIM, len(mean) - biases)
        inputs = (mean[None, :STATE_DIM], mean[None, own])[: factor.variables.shape[1]]
        (residual,), blocks = factor.compute(slice(None), inputs)
        H = np.zeros((factor.dim, len(mean)))
        H[:, :STATE_DIM] = blocks[0][0]
        if len(blocks) > 1:
            H[:, own] = blocks[1][0]
        bend = _bend(factor, inputs, blocks[0], covariance[:STATE_DIM, :STATE_DIM])
        residual = residual + 0.5 * np.trace(bend, axis1=1, axis2=2)
        noise = np.eye(factor.dim) + 0.5 * np.einsum("aij,bji->ab", bend, bend)
        spread = H @ covariance @ H.T
        innovation = whitened(-residual, spread + noise)
        (weight,) = factor.loss.weight(np.array([np.linalg.norm(innovation)]))
        return cls(residual, H, noise / weight, spread, innovation)


def _bend(factor: FactorBatch, inputs: tuple[Array, ...], jacobian: Array, covariance: Array) -> Array:
    """(r, 9, 9) whitened, second derivatives of the residual of a batch of one factor along the root of a covariance.

    They are differences of Jacobians over one standard deviation: closer ones would not show how far a line holds.
    Where a displaced state has no Jacobian, they are zero.
    """
    if not variances_positive(covariance):
        return np.zeros((factor.dim, STATE_DIM, STATE_DIM))
    root = np.linalg.cholesky(definite(covariance))
    displaced = (inputs[0] + root.T, *(np.repeat(one, len(root), axis=0) for one in inputs[1:]))
    with np.errstate(all="ignore"):
        change = factor.compute(np.zeros(len(root), dtype=np.int64), displaced)[1][0] - jacobian
    found = np.where(np.isfinite(change), change, 0.0).transpose(1, 0, 2) @ root
    return np.asarray(0.5 * (found + found.swapaxes(1, 2)))


def scatter(innovations: Array) -> float:
    """How far measurements lie from their predictions, in what they and these state; 1 if both are right.

    The median counts, so that outliers do not.

    Args: innovations: (m, dim) whitened.
    Returns: NaN for fewer than `LEAST_JUDGED`.
    """
    from scipy import special  # it takes a tenth of a second to import

    squares = np.square(innovations[np.isfinite(innovations).all(axis=1)]).sum(axis=1)
    if len(squares) < LEAST_JUDGED:
        return float("nan")
    return float(np.sqrt(np.median(squares) / special.chdtri(innovations.shape[1], 0.5)))


def leave_position_out(states: Array, covariances: Array, measured: Array, noise: Array, samples: Rows) -> Array:
    """(n, 3) whitened innovations of positions.

    With the sample's share M taken out of the posterior information, the others know the position to C = (P^-1 - M)^-1;
    without the sample's pull g = M (x - z) (for a robust loss: its gradient) they place it at x + C g. The measurement
    z lies z - x - C g from there, with covariance R + C.

    Args:
        states: (n, 3) m, the positions x that measurements should show, or (n, 9), beginning with them.
        covariances: (n, 3, 3) or (n, 9, 9) of the states.  measured: (n, 3) m.
        noise: (n, 3, 3) m^2, covariances R of the measurements.
        samples: the position factors, linearised at the states.
    """
    residual, (jacobian,) = weighted(samples)
    jacobian = jacobian[..., POSITION]
    pull = (jacobian.swapaxes(-1, -2) @ residual[..., None])[..., 0]
    information = np.linalg.inv(covariances[:, POSITION, POSITION])
    scale = 1.0 / np.sqrt(np.diagonal(information, axis1=-2, axis2=-1))
    both = scale[:, :, None] * scale[:, None, :]
    others = (information - jacobian.swapaxes(-1, -2) @ jacobian) * both
    # a sample that alone determines its position leaves nothing: bound C, the whitened distance goes to zero
    covariance = _inverse_of_rest(others) * both
    distance = measured - states[:, POSITION] - (covariance @ pull[..., None])[..., 0]
    return whitened(distance, np.asarray(covariance + noise, dtype=np.float64))


def _inverse_of_rest(information: Array) -> Array:
    """(n, r, r) inverse of the remaining information near one; rounding may make it negative."""
    values, vectors = np.linalg.eigh(0.5 * (information + information.swapaxes(-1, -2)))
    inverse = 1.0 / (np.maximum(values, 0.0) + LEAST_INFORMATION)
    return np.asarray((vectors * inverse[..., None, :]) @ vectors.swapaxes(-1, -2))


def leave_one_out(rows: Rows, covariances: Covariances) -> Array:
    """(m, r) whitened innovations of factors on one state each, and on the coefficients if they see them.

    As `leave_position_out`, in the units of whitened residuals: with the Jacobian H of a measurement and its share S =
    H P H^T of the information, the other measurements predict it with covariance C = S (1 - S)^-1, at a distance -(r +
    C r); for a robust loss, H and r in S and in the pull are the weighted ones. The covariance of that distance is 1 +
    C. A measurement that says nothing, H = 0, has none: NaN.

    Args: rows: the factors, linearised at the minimum.  covariances: of the states there and of the coefficients.
    """
    state, unit = rows.variables[:, 0], np.eye(rows.residual.shape[1])
    plain, (residual, jacobians) = np.concatenate(rows.jacobians, axis=-1), weighted(rows)
    pulled = np.concatenate(jacobians, axis=-1)
    joint = covariances.states[state]
    if len(jacobians) > 1:
        joint = joint_covariance(joint, covariances.cross[state], covariances.coefficients)
    gain = joint @ pulled.swapaxes(-1, -2)
    # a measurement that alone determines its value leaves nothing: bound C, the whitened distance goes to zero
    left = _inverse_of_rest(unit - pulled @ gain)
    others = joint + gain @ left @ gain.swapaxes(-1, -2)
    pull = pulled.swapaxes(-1, -2) @ residual[..., None]
    distance = -rows.residual - (plain @ others @ pull)[..., 0]
    found = whitened(distance, unit + plain @ others @ plain.swapaxes(-1, -2))
    return np.where(np.any(plain, axis=(1, 2), keepdims=True)[..., 0], found, np.nan)
