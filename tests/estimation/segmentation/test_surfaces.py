"""Tables with edges, floors, balls that rest and roll, other balls than those of table tennis."""

from dataclasses import replace

import numpy as np
import pytest

from ballfg.dynamics import Surfaces, nominal_model
from ballfg.dynamics.model_file import model_from_dict
from ballfg.estimation.segmentation.physics import physics_of
from tests.estimation.segmentation.whole_tracks import segment

EDGED = Surfaces(0.75, 0.0, (-0.76, 0.76, -1.37, 1.37))
UNKNOWN = Surfaces(0.75, 0.0)
TIMES = np.arange(0, 2, 1 / 180)


@pytest.fixture(scope="module")
def see(make_flight):
    """Flies a ball among true surfaces, measures it, and segments it with what is known of them."""

    def run(start, true, known, model=None, hits=None, sigma=0.0015, times=TIMES):
        model = model or nominal_model()
        truth = make_flight(model, start, times, true, hits)
        positions = truth.measured(np.random.default_rng(0), sigma)
        return truth, segment(times, positions, sigma, surfaces=known, physics=physics_of(model))

    return run


def check_contacts(match, found, truth):
    assert match([c.interval for c in found.contacts], truth.contacts) == (0, 0)
    assert [c.height for c in found.contacts] == [
        0.75 if truth.states[c.interval, 2] > 0.75 else 0.0 for c in found.contacts
    ]


@pytest.mark.parametrize("known", [EDGED, UNKNOWN])
def test_off_the_table_onto_the_floor(see, match, known):
    truth, found = see([0, -1, 1.1, 0, 3, 1, 0, 0, 0], EDGED, known)
    check_contacts(match, found, truth)
    assert {c.height for c in found.contacts} == {0.75, 0.0}
    assert len(found.hits) == 0


@pytest.mark.parametrize("lean", [{"x": 0.0, "y": 0.06}, {"x": -0.05, "y": 0.03}])
def test_a_table_that_is_not_level(see, match, lean):
    """Where the ball bounces it lies some centimetres above or below its height at the origin."""
    physics = {"flight": {"gravity": {}, "drag": {"k": 0.1}}, "bounce": {"restitution": {"e": 0.9}, "friction": {}}}
    leaning = model_from_dict({**physics, "bounce": {**physics["bounce"], "table_tilt": lean}})
    truth, found = see([-0.7, -1.2, 1.2, 1.0, 1.5, 1, 0, 0, 0], EDGED, EDGED, leaning, times=TIMES[:150])
    assert len(truth.contacts) >= 1
    check_contacts(match, found, truth)
    assert len(found.hits) == 0
    level, asked = physics_of(model_from_dict(physics)), physics_of(leaning)
    assert asked.restitution == pytest.approx(level.restitution, rel=1e-9)
    assert asked.friction == pytest.approx(level.friction, rel=1e-9)


@pytest.mark.parametrize("known", [EDGED, UNKNOWN])
def test_beside_the_table(see, match, known):
    truth, found = see([0, 1, 1.1, 0, 3, 1, 0, 0, 0], EDGED, known)
    check_contacts(match, found, truth)
    assert {c.height for c in found.contacts} == {0.0}
    assert len(found.hits) == 0


def test_a_floor_may_be_duller_than_the_table(make_flight, match):
    """The ball is known to keep 0.9 of its speed on the table; on the floor it keeps 0.6."""
    dull = model_from_dict({"flight": {"gravity": {}, "drag": {}}, "bounce": {"restitution": {"e": 0.6}}})
    truth = make_flight(dull, [0, 1, 1.1, 0, 3, 1, 0, 0, 0], TIMES[:180], EDGED)
    positions = truth.measured(np.random.default_rng(0), 0.0015)
    found = segment(TIMES[:180], positions, 0.0015, surfaces=EDGED, physics=replace(physics_of(dull), restitution=0.9))
    assert len(truth.contacts) >= 1
    check_contacts(match, found, truth)
    assert len(found.hits) == 0


@pytest.mark.parametrize("known", [EDGED, UNKNOWN])
def test_a_ball_rolls_over_the_edge(see, match, known):
    truth, found = see([0, 0.8, 0.767, 0.1, 0.8, 0, -40, 0, 0], EDGED, known)
    leaves = int(np.argmax(truth.states[:, 2] < 0.7669))
    assert len(found.rests) == 1
    assert found.rests[0].first == 0
    assert abs(found.rests[0].last - leaves) <= 8
    assert found.rests[0].height == 0.75
    check_contacts(match, found, truth)
    assert len(found.hits) == 0


def test_the_table_has_no_surface_where_it_is_known_to_end(see):
    """The same bounces, told that the table ends before them: no contact, so something else must have hit the ball."""
    short = Surfaces(0.75, 0.0, (-0.76, 0.76, -9.0, -2.0))
    _, found = see([0, -1, 1.1, 0, 3, 1, 0, 0, 0], EDGED, short)
    assert all(c.height == 0.0 for c in found.contacts)
    assert len(found.hits) >= 3


@pytest.mark.parametrize("start", [[0, 0, 0.767, 0.3, 0.6, 0, 0, 0, 0], [0, 0, 0.767, 0, 0, 0, 0, 0, 0]])
def test_a_rolling_or_lying_ball_is_one_rest(see, start):
    _, found = see(start, Surfaces(0.75), Surfaces(0.75))
    assert [(r.first, r.last, r.height) for r in found.rests] == [(0, len(TIMES) - 2, 0.75)]
    assert found.contacts == ()
    assert len(found.hits) == 0
    assert found.usable.all()


def test_lower_and_lower_bounces_end_in_rest(see, match):
    truth, found = see([0, 0, 0.79, 0.3, 0.6, 0, 0, 0, 0], Surfaces(0.75), Surfaces(0.75))
    assert len(found.rests) == 1
    rest = found.rests[0]
    low = [i for i in truth.contacts if truth.states[i + 1, 5] < 0.25]  # bounces of less than 3 mm
    assert low[0] - 20 < rest.first < truth.contacts[-1] + 5
    assert rest.last == len(TIMES) - 2
    high = [i for i in truth.contacts if truth.states[i + 1, 5] > 0.3]
    assert match([c.interval for c in found.contacts], high, 2)[0] == 0
    landing = found.contacts[-1]
    assert landing.interval == rest.first - 1  # the ball lands in the interval before the rest
    assert len(found.hits) == 0


def test_a_resting_ball_is_hit(make_flight):
    surfaces = Surfaces(0.75)
    still = make_flight(nominal_model(), [0, 0, 0.767, 0, 0, 0, 0, 0, 0], TIMES[:100], surfaces)
    flying = make_flight(nominal_model(), [0, 0, 0.767, 1, 3, 2, 0, 0, 0], TIMES[:60], surfaces)
    rng = np.random.default_rng(0)
    times = np.concatenate([still.times, still.times[-1] + 1 / 180 + flying.times])
    positions = np.concatenate([still.measured(rng), flying.measured(rng)])
    found = segment(times, positions, 0.0015, surfaces=surfaces, physics=physics_of(nominal_model()))
    assert [(r.first, r.height) for r in found.rests] == [(0, 0.75)]
    assert len(found.hits) == 1
    assert abs(int(found.hits[0]) - 99) <= 2
    assert found.rests[0].last == found.hits[0] - 1


@pytest.fixture(scope="module")
def tennis():
    return model_from_dict(
        {
            "flight": {"gravity": {"g": 9.81}, "drag": {"k": 0.02}, "magnus": {"k": 0.0005}},
            "bounce": {"restitution": {"e": 0.75}, "friction": {"mu": 0.6}},
        },
        radius=0.0335,
    )


@pytest.mark.parametrize(
    ("start", "hits"),
    [
        ([0, 0, 1.0, 0, 28, 3, -150, 0, 0], {}),
        ([0, 0, 2.6, 2, 55, -4, -200, 0, 0], {}),
        ([0, 0, 1.0, 0, 28, 1, -150, 0, 0], {100: [0, -30, 4]}),
    ],
    ids=["drive", "serve", "return"],
)
def test_tennis(see, match, tennis, start, hits):
    court = Surfaces(0.0)
    truth, found = see(start, court, court, tennis, hits, sigma=0.005, times=TIMES[:280])
    assert match([c.interval for c in found.contacts], truth.contacts) == (0, 0)
    assert match(found.hits.tolist(), truth.hits, 2) == (0, 0)
    assert (found.quality >= 2).sum() <= 1
