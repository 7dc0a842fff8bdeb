"""Where all balls are alike, or soon past an event, the shortcut tells what possible balls on the whole way do."""

import numpy as np
import pytest

from ballfg.dynamics import Surfaces, nominal_model
from ballfg.factors.noise import ProcessNoise
from ballfg.prediction import BallState
from ballfg.prediction.event_ahead import event_on
from ballfg.prediction.forecast import carried_by
from ballfg.prediction.path import Path
from ballfg.prediction.plane import Line, Plane
from ballfg.prediction.state import World

TABLE = (-1.4, 1.4, -0.8, 0.8)
ROOMS = [Surfaces(0.0), Surfaces(0.0, -0.76), Surfaces(0.0, -0.76, TABLE, (0.02,) * 4)]


def state_of(rng: np.random.Generator, surfaces: Surfaces) -> BallState:
    """A ball above the table, known well or badly."""
    place = rng.uniform((-1.5, -0.9, 0.02), (1.5, 0.9, 1.2))
    mean = np.concatenate((place, rng.normal(0.0, 3.0, 3), rng.normal(0.0, 60.0, 3)))
    sigmas = 10.0 ** rng.uniform((-4.0, -2.0, -1.0), (-1.5, 0.3, 2.0))
    world = World(nominal_model(), surfaces, ProcessNoise())
    return BallState(time=0.0, mean=mean, joint=np.diag(np.repeat(sigmas**2, 3)), world=world)


@pytest.mark.parametrize("surfaces", ROOMS)
def test_no_possible_ball_crosses_a_plane_that_all_stay_off(surfaces: Surfaces) -> None:
    rng, off = np.random.default_rng(5), 0
    for _ in range(150):
        state = state_of(rng, surfaces)
        normal = np.eye(3)[rng.integers(3)] if rng.random() < 0.7 else rng.normal(size=3)
        place = float(normal @ state.state[:3] + rng.normal())
        direction = ("either", "up", "down")[rng.integers(3)]
        line = Line.of(Plane(tuple(normal.tolist()), place, direction, int(rng.integers(3))))
        path = Path(state, carried_by(state), float(rng.uniform(0.2, 1.5)))
        found, alike = path.event(line)
        if found is None and alike:
            off += 1
            assert path.probability(line) == 0.0
    assert off > 15


def test_near_a_bounce_a_short_way_tells_what_the_whole_one_does() -> None:
    rng, short = np.random.default_rng(6), 0
    for _ in range(600):  # of some, a few balls are much slower than the mean
        state = state_of(rng, ROOMS[1])
        axis = int(rng.integers(2))
        along = (float(axis == 0), float(axis == 1), 0.0)
        place = float(state.state[axis] + rng.uniform(0.1, 0.8) * state.state[3 + axis])
        line, whole = Line.of(Plane(along, place)), Path(state, carried_by(state), 1.5)
        found, alike = whole.event(line)
        times, places, met = whole._events(line)
        if found is None or not alike or not (met != met[0]).any():
            continue
        short += 1
        assert whole.probability(line) == event_on(whole, Plane(along, place)).probability == 1.0
        late = np.sqrt(((times - found.time) ** 2).mean())
        assert found.time_sigma == pytest.approx(late, rel=0.05)
        wide = np.sqrt(((places[:, :3] - found.state[:3]) ** 2).mean(axis=0))
        np.testing.assert_allclose(np.sqrt(np.diagonal(found.covariance)[:3]), wide, rtol=0.05, atol=1e-9)
    assert short > 15
