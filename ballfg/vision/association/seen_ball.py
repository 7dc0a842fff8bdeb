"""One ball as several cameras saw it: its points in space, and the sightings they come from."""

from dataclasses import dataclass

from ballfg.tracks.sightings import Sightings
from ballfg.vision.arrays import Array, Rows


@dataclass(frozen=True, eq=False)
class SeenBall:
    """One ball's track, in order of time."""

    times: Array
    """(n,) s, true time."""

    points: Array
    """(n, 3) m, world."""

    covariances: Array
    """(n, 3, 3) m^2, of each point by itself; interpolated points share samples and so a little of their error."""

    sightings: Sightings
    """What the points come from, each at its own camera's stamp."""

    views: Rows
    """(n,) how many cameras made each point."""

    def __len__(self) -> int:
        return len(self.times)
