"""Takes the shadow of a ball on the table as the picture of a second camera: the lamp.

A lamp casts the ball onto the table where a camera at the lamp's place would see it, so the shadow's place on the table
is a pixel of such a camera. One camera that sees ball and shadow sees as much as two.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import shown
from ballfg.estimation.observations.rig import cameras_of
from ballfg.tracks.info import Lamp
from ballfg.tracks.sightings import Sightings
from ballfg.vision.camera import Camera

SHADOWS_FILE: Final = "shadows.csv"
LAMP: Final = "lamp"  # name of its camera
FOCAL: Final = 1000.0
"""px, of a lamp's picture, in which a pixel is a thousandth of its height above the table."""
SIZE: Final = 100_000  # px, of that picture: a lamp just above the table sees it wide
EXACT: Final = 1e-9  # rad, and of the logarithm: a lamp whose place is not exact casts no other picture
LEAST_HEIGHT: Final = 0.1  # m, of a lamp above the table
STEP: Final = 0.5  # px, of differences
MOMENT: Final = 1e-6  # s, within which shadows are of one moment


def lamp_camera(name: str, lamp: Lamp, table: float) -> Camera:
    """The camera that sees the table, at z = `table` m, from a lamp straight down.

    Raises: ValueError: a lamp that is not above the table.
    """
    height = lamp.place[2] - table
    if not height >= LEAST_HEIGHT:
        raise ValueError(
            f"lamp.place must be {LEAST_HEIGHT:g} m or more above the table at z = {table:g} m; got z = "
            f"{lamp.place[2]:g}. Measure it in the world of the cameras."
        )
    middle = (SIZE - 1.0) / 2.0
    matrix = np.array([[FOCAL, 0.0, middle], [0.0, FOCAL, middle], [0.0, 0.0, 1.0]])
    spread = np.diag([EXACT**2] * 3 + [lamp.sigma**2] * 3 + [EXACT**2]) if lamp.sigma else None
    pose = np.array([np.pi, 0.0, 0.0]), -np.diag([1.0, -1.0, -1.0]) @ np.array(lamp.place)
    return Camera(name, (SIZE, SIZE), matrix, np.zeros(0), *pose, covariance=spread)


def with_shadows(
    seen: Sightings, shadows: Sightings, cameras: Sequence[Camera], lamp: Lamp, table: float
) -> tuple[Sightings, list[Camera]]:
    """The sightings of a ball, then those by its lamp, and the cameras with the lamp's, `lamp`.

    Of shadows that several cameras saw at one moment the surest counts.

    Args:
        seen: of the ball.  shadows: of its shadow on the table.  cameras: of the rig, which both name.
        lamp: that casts it.  table: m, z of the table's surface.
    Raises: ValueError: a lamp that is not above the table, a shadow that is not on it, a camera named `lamp`.
    """
    rig, light = cameras_of(shadows, cameras), lamp_camera(LAMP, lamp, table)
    numbers = np.unique(shadows.camera).tolist()
    parts = [_by_the_lamp(shadows.select(shadows.camera == number), rig[number], light, table) for number in numbers]
    times, pixels, spread = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    moment = np.round((times - times.min()) / MOMENT)
    order = np.lexsort((np.trace(spread, axis1=1, axis2=2), moment))
    rows = order[np.append(True, np.diff(moment[order]) > 0.0)]
    own = (np.append(seen.times, times[rows]), np.concatenate((seen.pixels, pixels[rows])))
    cues = dict[str, Array]()
    for name, absent in (("radii", (0.0, 1.0)), ("streaks", (0.0, 0.0)), ("shifts", (0.0, 0.0, 0.0))):
        if getattr(seen, name) is not None:
            cues[name] = np.concatenate((getattr(seen, name), np.tile(absent, (len(rows), 1))))
    by = np.append(seen.camera, np.full(len(rows), len(seen.cameras)))
    both = Sightings((*seen.cameras, LAMP), by, *own, np.concatenate((seen.covariances, spread[rows])), **cues)
    return both, [*cameras, light]


def _by_the_lamp(shadows: Sightings, camera: Camera, light: Camera, table: float) -> tuple[Array, Array, Array]:
    """(n,) s, true times, pixels (n, 2) of the lamp's picture and their covariances, of shadows that one camera saw."""

    def moved(pixels: Array) -> Array:
        """(n, 2) px of the lamp's picture, of pixels (n, 2) of the camera's."""
        rays = camera.rays(pixels)
        far = (table - centres[:, 2]) / np.where(rays[:, 2] < 0.0, rays[:, 2], np.nan)
        return light.project(centres + far[:, None] * rays)

    shifts = np.zeros((len(shadows), 3)) if shadows.shifts is None else shadows.shifts
    centres = camera.centre + shifts
    pixels = moved(shadows.pixels)
    if not np.isfinite(pixels).all():
        row = int(np.argwhere(~np.isfinite(pixels))[0][0])
        raise ValueError(
            f"camera {shown(camera.name)}: a shadow must lie on the table; the one at t = {shadows.times[row]:g} s, "
            f"{shadows.pixels[row].tolist()} px, lies above the horizon. Delete it."
        )
    steps = [STEP * np.array([1.0, 0.0]), STEP * np.array([0.0, 1.0])]
    ends = [moved(shadows.pixels + step) - moved(shadows.pixels - step) for step in steps]
    slope = np.stack(ends, axis=2) / (2.0 * STEP)
    spread = slope @ shadows.covariances @ slope.swapaxes(1, 2)
    return camera.true_times(shadows.times, shadows.pixels), pixels, 0.5 * (spread + spread.swapaxes(1, 2))
