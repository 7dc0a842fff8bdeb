"""Events put together: which intervals of a track a rest holds, and what is left of a ball after a restart."""

import numpy as np
import pytest

from ballfg.estimation.segmentation.bank import FLYING, HYPOTHESIS
from ballfg.estimation.segmentation.batch import rests_of
from ballfg.estimation.segmentation.result import Event, EventKind
from ballfg.estimation.segmentation.settings import SegmentationSettings
from ballfg.estimation.segmentation.surface_contact import forget

HEIGHT = 0.76


@pytest.mark.parametrize(
    ("end", "index", "last"),
    [
        (None, None, 18),  # to the last interval of 20 samples
        (EventKind.LEAVE, 10, 10),  # it leaves at the end of its interval
        (EventKind.LEAVE, 5, 5),
        (EventKind.HIT, 10, 9),  # somewhere inside the interval
        (EventKind.RESTART, 6, 5),
        (EventKind.HIT, 5, None),  # no interval is whole
    ],
)
def test_a_rest_holds_the_whole_intervals_on_the_surface(end, index, last) -> None:
    events = [Event(EventKind.CONTACT, 2, 0.02, HEIGHT), Event(EventKind.REST, 4, 0.05, HEIGHT)]
    if end is not None:
        events += [Event(end, index, 0.01 * index), Event(EventKind.OUTLIER, 13, 0.13)]
    found = [(rest.first, rest.last, rest.height) for rest in rests_of(events, 20)]
    assert found == ([] if last is None else [(5, last, HEIGHT)])


def test_a_forgotten_ball_is_at_a_place_and_moves_in_any_way() -> None:
    bank = np.zeros(1, HYPOTHESIS)
    for name in ("mean", "cov", "shift", "age", "surface"):
        bank[name] = 7.0
    settings = SegmentationSettings()
    forget(bank[0], FLYING, np.array([1.0, -2.0, 0.5]), 0.04, settings.velocity_spread, settings.slack)
    np.testing.assert_array_equal(bank[0]["mean"], [[1.0, 0.0, 0.0], [-2.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    spread = np.diag([0.04, settings.velocity_spread**2, settings.slack**2])
    np.testing.assert_allclose(bank[0]["cov"], np.stack([spread] * 3), rtol=1e-12)
    assert not bank[0]["shift"].any()
    assert (bank[0]["surface"], bank[0]["age"]) == (FLYING, 0)
