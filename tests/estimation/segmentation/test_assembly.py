"""Events put together: which intervals of a track a rest holds."""

import pytest

from ballfg.estimation.segmentation.assembly import rests_of
from ballfg.estimation.segmentation.events import Event, EventKind

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
