"""States between the nodes of an arc, of balls whose motion is a polynomial: these are met exactly."""

import numpy as np

from ballfg.dynamics.compiled.samples import sample

STEP, DIRECTIONS, BALLS = np.array((0.02, 0.05)), 2, 2


def polynomials(rng):
    """Positions of degree 5 in the time and spins of degree 3, by ball and axis."""
    return [[np.polynomial.Polynomial(rng.normal(size=degree + 1)) for _ in range(3 * BALLS)] for degree in (5, 3)]


def states(motion, times):
    """(m, k, 9) at times (m, k) since the arc began."""
    positions, spins = motion
    found = np.empty((*times.shape, 9))
    for m in range(BALLS):
        for axis in range(3):
            course = positions[3 * m + axis]
            found[m, :, axis], found[m, :, 3 + axis] = course(times[m]), course.deriv()(times[m])
            found[m, :, 6 + axis] = spins[3 * m + axis](times[m])
    return found


def rates(motion, times):
    """(m, k, 9) of the states by time."""
    positions, spins = motion
    return states(([p.deriv() for p in positions], [s.deriv() for s in spins]), times)


def test_states_between_nodes_are_those_of_a_polynomial_motion() -> None:
    rng = np.random.default_rng(5)
    motion, moved = polynomials(rng), [polynomials(rng) for _ in range(DIRECTIONS)]
    nodes_at = STEP[:, None] * np.arange(4)
    nodes, slopes = states(motion, nodes_at), rates(motion, nodes_at)
    nodes_moved = np.stack([states(direction, nodes_at) for direction in moved], axis=-1)
    slopes_moved = np.stack([rates(direction, nodes_at) for direction in moved], axis=-1)
    begun, began = rng.normal(size=BALLS), rng.normal(size=(BALLS, DIRECTIONS))
    since = STEP[:, None] * np.array((0.0, 0.3, 1.0, 1.9, 2.5, 3.0))
    later = rng.normal(size=(*since.shape, DIRECTIONS))
    value, tangent = np.empty((*since.shape, 9)), np.empty((*since.shape, 9, DIRECTIONS))
    times = begun[:, None] + since
    arc = (np.arange(BALLS), begun, began, STEP, nodes, slopes, nodes_moved, slopes_moved)
    sample(True, times, later, *arc, 3, value, tangent)
    np.testing.assert_allclose(value, states(motion, since), rtol=0, atol=1e-12)
    # the motion itself moves, and so do the time asked for and the time at which the arc begins
    by_motion = np.stack([states(direction, since) for direction in moved], axis=-1)
    shift = later - began[:, None]
    wanted = by_motion + rates(motion, since)[..., None] * shift[:, :, None]
    np.testing.assert_allclose(tangent, wanted, rtol=0, atol=1e-9)
    where, by = np.empty((*since.shape, 3)), np.empty((*since.shape, 3, DIRECTIONS))
    sample(True, times, later[..., :0], *arc, 1, where, by)
    np.testing.assert_array_equal(where, value[..., :3])
    still = by_motion - rates(motion, since)[..., None] * began[:, None, None]
    np.testing.assert_allclose(by, still[..., :3, :], rtol=0, atol=1e-9)
