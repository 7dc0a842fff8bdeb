"""What a set of tracks spans: where the balls flew, how high, how fast; effects say in which shapes they may act."""

from dataclasses import dataclass

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Scene:
    """Extent of the data.

    Attributes:
        low, high, middle: m, of the positions; the middle is the median.
        speed: m/s, median over samples.
        impact_speed: m/s, median normal speed of impacts; NaN without contacts.
        contacts, labels: how many contacts and spin labels there are.
    """

    low: Vector
    high: Vector
    middle: Vector
    speed: float
    impact_speed: float
    contacts: int
    labels: int
