"""Contacts at which something else was touched as well: what the jump of the velocity says, and from which samples."""

from dataclasses import replace

import numpy as np
import pytest

from ballfg.dynamics import nominal_model
from ballfg.estimation.segmentation.batch import hits_at_contacts
from ballfg.estimation.segmentation.physics import physics_of
from ballfg.estimation.segmentation.result import Contact
from ballfg.estimation.segmentation.settings import SegmentationSettings

AT = 20
"""Interval of the contact, in its middle."""
TIMES = np.arange(41) / 180.0


def looked_at(after: float, usable: range | np.ndarray, drag: float | None = None) -> list[int]:
    """The verdict on a bounce that comes with 5 m/s along x and leaves with another velocity along it, without air."""
    physics = physics_of(nominal_model())
    physics = physics if drag is None else replace(physics, drag=drag)
    since = TIMES - (TIMES[AT] + TIMES[AT + 1]) / 2
    late = since > 0.0
    positions = np.stack((np.where(late, after, 5.0) * since, 0.0 * since, np.where(late, 2.7, -3.0) * since), axis=-1)
    positions[:, 2] -= 0.5 * physics.gravity * since**2
    kept = np.zeros(len(TIMES), dtype=bool)
    kept[np.asarray(usable)] = True
    contact = Contact(AT, float((TIMES[AT] + TIMES[AT + 1]) / 2), 0.0)
    return hits_at_contacts(TIMES, positions, kept, [contact], [], physics, SegmentationSettings())


@pytest.mark.parametrize(("after", "hit"), [(5.0, False), (4.0, False), (-1.0, True), (9.0, True)])
def test_more_than_friction_can_do_is_a_hit(after, hit) -> None:
    """At 3 m/s downwards friction changes the motion along the table by 0.25 x 1.9 x 3 m/s at most."""
    assert looked_at(after, np.arange(41)) == ([AT] if hit else [])


@pytest.mark.parametrize(("beyond", "hit"), [(0.2, False), (0.4, True)])
def test_noise_and_the_magnus_force_may_add_three_tenths_of_a_metre_a_second(beyond, hit) -> None:
    physics, excess = physics_of(nominal_model()), SegmentationSettings().friction_excess
    limit = excess * physics.friction * (1.0 + physics.restitution) * 3.0
    assert looked_at(5.0 + limit + beyond, np.arange(41), drag=0.0) == ([AT] if hit else [])


@pytest.mark.parametrize(
    ("before", "after", "told"),
    [
        (range(13, 17), range(21, 25), True),  # the eight samples before it begin with number 13
        (range(12, 16), range(21, 25), False),
        (range(17, 21), range(25, 29), True),  # and those after it end with number 28
        (range(17, 21), range(26, 30), False),
        (range(13, 21), range(21, 24), False),  # three after it: those before it do not stand in for a fourth
        (range(18, 21), range(21, 29), False),
    ],
)
def test_four_of_the_eight_samples_on_either_side_are_needed(before, after, told) -> None:
    assert looked_at(-1.0, [*before, *after]) == ([AT] if told else [])
