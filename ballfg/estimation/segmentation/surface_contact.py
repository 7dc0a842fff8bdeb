"""Moves hypotheses over a time step, and branches them at a possible contact: no contact, a bounce, or rest."""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numba import types

from ballfg.arrays import Array
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, FLAG, NOTHING, ONE, REAL, several
from ballfg.dynamics.surfaces import within
from ballfg.estimation.segmentation import bank
from ballfg.estimation.segmentation.result import CONTACT, REST

STRONGEST_DRAG: Final = 0.5
"""Largest share of its velocity that a ball may lose to drag in one step: bounds absurd velocities, such as those from
two outliers 1 ms apart."""
REST_SIGMA: Final = 0.003
"""m. Spread of the measured height of a resting ball about its surface, constant during the rest."""
LANDING_SIGMA: Final = 0.2
"""m/s. Change of the horizontal velocity of a ball that stays down."""


@machine_code(NOTHING(bank.ONE_HYPOTHESIS, COUNT, REAL, REAL, REAL, REAL, REAL))
def transform(h: bank.Record, axis: int, way: float, half: float, kept: float, gain: float, memory: float) -> None:
    """P + way v + half b, kept v + gain b, memory b; mean and covariance of one axis."""
    mean, cov = h.mean[axis], h.cov[axis]
    mean[0] = mean[0] + way * mean[1] + half * mean[2]
    mean[1] = kept * mean[1] + gain * mean[2]
    mean[2] *= memory
    for k in range(3):
        p, v, b = cov[0, k], cov[1, k], cov[2, k]
        cov[0, k], cov[1, k], cov[2, k] = p + way * v + half * b, kept * v + gain * b, memory * b
    for i in range(3):
        p, v, b = cov[i, 0], cov[i, 1], cov[i, 2]
        cov[i, 0], cov[i, 1], cov[i, 2] = p + way * v + half * b, kept * v + gain * b, memory * b


@machine_code(NOTHING(bank.ONE_HYPOTHESIS, COUNT, ONE, REAL, REAL, REAL))
def forget(h: bank.Record, surface: int, position: Array, variance: float, speed: float, slack: float) -> None:
    """Puts a hypothesis at a position (3,) m with a variance m^2; of velocity and slack only the spreads are known."""
    h.surface, h.age = surface, 0
    for axis in range(3):
        h.shift[axis] = 0.0
        for i in range(3):
            h.mean[axis, i] = 0.0
            for k in range(3):
                h.cov[axis, i, k] = 0.0
        h.mean[axis, 0] = position[axis]
        h.cov[axis, 0, 0] = variance
        h.cov[axis, 1, 1] = speed * speed
        h.cov[axis, 2, 2] = slack * slack


MOST_AIR: Final = 30.0
"""m/s^2. Largest spread of the slack: bounds absurd velocities."""


@machine_code(REAL(bank.ONE_HYPOTHESIS, bank.SCENE))
def slack_spread(h: bank.Record, scene: bank.Record) -> float:
    """m/s^2, spread of the slack acceleration: spin and wind act with the air, friction on a surface."""
    if h.surface != bank.FLYING:
        return scene.friction * scene.gravity
    squared = h.mean[0, 1] ** 2 + h.mean[1, 1] ** 2 + h.mean[2, 1] ** 2
    return min(scene.still_air + scene.air_growth * scene.drag * squared, MOST_AIR)


@machine_code(NOTHING(bank.ONE_HYPOTHESIS, REAL, bank.SCENE))
def carry(h: bank.Record, t: float, scene: bank.Record) -> None:
    """A hypothesis t s later, without an event: a flying ball flies, a resting one stays down; changes `h`.

    Drag is linearised at the present speed, equal on the three axes: v' = (1 - k |v| dt) v + (b - g) dt. The slack b
    forgets itself. Negative steps go back, and add noise like positive ones.
    """
    step, half = abs(t), 0.5 * t * t
    speed = math.sqrt(h.mean[0, 1] ** 2 + h.mean[1, 1] ** 2 + h.mean[2, 1] ** 2)
    loss = min(max(scene.drag * speed * t, -STRONGEST_DRAG), STRONGEST_DRAG)
    a, b, memory = t * (1.0 - 0.5 * loss), 1.0 - loss, math.exp(-step / scene.air_memory)
    axes = 3 if h.surface == bank.FLYING else 2
    for axis in range(axes):
        transform(h, axis, a, half, b, t, memory)
        mean, cov = h.mean[axis], h.cov[axis]
        for i in range(2):
            for k in range(2):
                cov[i, k] += step * (scene.drift[0, i, k] + step * (scene.drift[1, i, k] + step * scene.drift[2, i, k]))
        if axis == 2:
            mean[0] -= scene.gravity * half
            mean[1] -= scene.gravity * t
    spread = slack_spread(h, scene)
    for axis in range(axes):
        h.cov[axis, 2, 2] += spread * spread * (1.0 - memory * memory)


@machine_code(NOTHING(bank.ONE_HYPOTHESIS, COUNT, bank.SCENE, bank.SURFACES))
def put_down(h: bank.Record, surface: int, scene: bank.Record, surfaces: bank.Records) -> None:
    """Makes a hypothesis rest on a surface."""
    h.surface = surface
    h.mean[2, 0] = surfaces[surface].centre + h.shift[2]
    h.mean[2, 1] = h.mean[2, 2] = 0.0
    for i in range(3):
        for k in range(3):
            h.cov[2, i, k] = 0.0
    h.cov[2, 0, 0] = REST_SIGMA**2
    for axis in range(2):
        h.mean[axis, 2] = 0.0
        for k in range(3):
            h.cov[axis, 2, k] = h.cov[axis, k, 2] = 0.0
        h.cov[axis, 2, 2] = slack_spread(h, scene) ** 2
        h.cov[axis, 1, 1] += LANDING_SIGMA**2


@machine_code(NOTHING(bank.ONE_HYPOTHESIS, bank.SCENE))
def lift(h: bank.Record, scene: bank.Record) -> None:
    """Makes a resting hypothesis fly, with a small unknown vertical speed."""
    h.surface = bank.FLYING
    h.cov[2, 1, 1] += scene.leave_speed**2
    for axis in range(3):
        h.cov[axis, 2, 2] += slack_spread(h, scene) ** 2


SLOWEST_CLOSING: Final = 0.2
"""m/s. Bounds the time margin of a slow contact."""
LEAST_FALL: Final = 0.05
"""m/s. A path that meets a surface more slowly grazes it without a contact."""
POSITION_JITTER: Final = 1e-3
"""m, additional uncertainty of the horizontal position after a contact."""
KNOWN_SPEED: Final = 1.0
"""m/s. A path with a less certain vertical speed, as after a single sample, is not taken to land slowly."""
BOUNCE_JITTER: Final = 0.03
"""m/s, of the normal velocity after a bounce, whatever its speed."""
SLIDE_JITTER: Final = 0.05
"""m/s, of the tangential velocity, likewise."""
SURELY: Final = 3.0
"""Standard deviations of a foretold height."""
WEAKEST_FALL: Final = 0.2
"""Share of gravity below which the slack cannot hold the ball up."""


class Step(NamedTuple):
    """A part of an interval: its duration dt s, the number of the interval, when it starts on the track's clock (s).

    `strict`: only contacts inside it; otherwise also such as the uncertainty of the path lets in. Parts of an interval
    are strict, or each contact would be tried by two of them.
    """

    dt: float
    interval: int
    start: float
    strict: bool


STEP: Final[Any] = types.NamedTuple((REAL, COUNT, REAL, FLAG), Step)


@machine_code(NOTHING(bank.WORK, STEP, bank.SCENE, bank.SURFACES))
def advance(work: bank.Work, step: Step, scene: bank.Record, surfaces: bank.Records) -> None:
    """All hypotheses of `work` after a step, branched at the contacts that may have happened."""
    h, lowest = work.fill[bank.USED], math.inf
    before = work.bank[:h].copy()
    for row in range(h):
        free = work.bank[row]
        carry(free, step.dt, scene)
        slope = min(free.mean[2, 1], -SLOWEST_CLOSING)
        lowest = min(lowest, free.mean[2, 0] - free.shift[2] + scene.contact_window * slope)
    for surface in range(len(surfaces)):
        if lowest < surfaces[surface].centre:
            _branch(before, work, surface, step, scene, surfaces)


@machine_code(FLAG(bank.BANK, REAL, bank.SCENE, bank.SURFACES))
def may_meet(held: bank.Records, dt: float, scene: bank.Record, surfaces: bank.Records) -> bool:
    """Whether the best hypothesis may come down to the highest surface within dt s."""
    if len(surfaces) == 0 or held[0].surface != bank.FLYING:
        return False
    later = held[:1].copy()
    carry(later[0], dt, scene)
    low = later[0].mean[2, 0] - later[0].shift[2] - SURELY * math.sqrt(later[0].cov[2, 0, 0])
    return low < surfaces[0].centre


@machine_code(NOTHING(bank.BANK, bank.WORK, COUNT, STEP, bank.SCENE, bank.SURFACES))
def _branch(
    before: bank.Records, work: bank.Work, surface: int, step: Step, scene: bank.Record, surfaces: bank.Records
) -> None:
    """Adds the hypotheses that meet one surface on the way: those that stay down, then those that bounce."""
    h = len(before)
    landed, times, count = np.empty(h, bank.HYPOTHESIS), np.empty(h), 0
    for row in range(h):
        time, speed = _meeting(before[row], surfaces[surface].centre, scene)
        if not _is_tried(before[row], time, speed, surface, step, scene):
            continue
        landed[count], times[count] = before[row], time
        here = landed[count]
        count += 1
        carry(here, time, scene)
        here.score -= scene.contact_cost
        here.age = 0
        bank.pass_through(here, work, CONTACT, step.interval, surface, step.start + time)
        if speed < scene.rest_speed and here.cov[2, 1, 1] < KNOWN_SPEED**2:
            down = work.bank[bank.add(work, landed, count - 1)]
            put_down(down, surface, scene, surfaces)
            carry(down, step.dt - time, scene)
            down.score -= scene.rest_cost
            bank.pass_through(down, work, REST, step.interval, surface, step.start + step.dt)
    for k in range(count):
        up = work.bank[bank.add(work, landed, k)]
        _bounce(up, surfaces[surface], scene)
        carry(up, step.dt - times[k], scene)


@machine_code(several(REAL, 2)(bank.ONE_HYPOTHESIS, REAL, bank.SCENE))
def _meeting(h: bank.Record, centre: float, scene: bank.Record) -> Any:
    """Time s and speed m/s at which the mean path comes down to a surface."""
    height, rise = h.mean[2, 0] - h.shift[2] - centre, h.mean[2, 1]
    drag = scene.drag * math.sqrt(h.mean[0, 1] ** 2 + h.mean[1, 1] ** 2 + rise**2)
    pull = max(scene.gravity - h.mean[2, 2] + drag * rise, WEAKEST_FALL * scene.gravity)
    speed = math.sqrt(max(rise * rise + 2.0 * pull * height, 0.0))  # zero if the path stays below
    return (rise + speed) / pull, speed


@machine_code(FLAG(bank.ONE_HYPOTHESIS, REAL, REAL, COUNT, STEP, bank.SCENE))
def _is_tried(h: bank.Record, time: float, speed: float, surface: int, step: Step, scene: bank.Record) -> bool:
    """Whether a meeting lies in the step, and on the surface as far as is known."""
    if h.surface != bank.FLYING or not speed > LEAST_FALL:
        return False
    if surface == 0:
        x = h.mean[0, 0] - h.shift[0] + h.mean[0, 1] * time
        y = h.mean[1, 0] - h.shift[1] + h.mean[1, 1] * time
        if not within(x, y, scene.extent):
            return False
    if step.strict:
        return 0.0 <= time < step.dt
    reach = 3.0 * math.sqrt(h.cov[2, 0, 0]) + 2.0 * scene.surface_sigma
    margin = min(reach / max(speed, SLOWEST_CLOSING), scene.contact_window)
    # one sample between two contacts, or one contact would be tried in two intervals running
    return -margin < time < step.dt + margin and h.age >= 1


@machine_code(NOTHING(bank.ONE_HYPOTHESIS, bank.SURFACES.dtype, bank.SCENE))
def _bounce(h: bank.Record, surface: bank.Record, scene: bank.Record) -> None:
    """A hypothesis at a contact, bounced: mirrored in z, slowed by the friction of an unknown spin.

    Friction changes the tangential velocity by mu (1 + e) v_n at most, either way: half of that is expected, up to the
    loss of a ball without spin, and half is the spread.
    """
    e, speed = scene.restitution, abs(h.mean[2, 1])
    friction = 0.5 * scene.friction * (1.0 + e) * speed
    sliding = max(math.hypot(h.mean[0, 1], h.mean[1, 1]), SLOWEST_CLOSING)
    keep = 1.0 - min(friction / sliding, scene.most_slowing)
    h.mean[2, 1] = e * speed
    h.mean[2, 0] = surface.centre + h.shift[2]
    # the Jacobian is diagonal: (1, keep, 1) along the surface, (-e, -e, 1) along its normal, for late or early paths
    for axis in range(2):
        h.mean[axis, 1] *= keep
        for k in range(3):
            h.cov[axis, 1, k] *= keep
            h.cov[axis, k, 1] *= keep
        h.cov[axis, 0, 0] += POSITION_JITTER**2
        h.cov[axis, 1, 1] += (SLIDE_JITTER + friction) ** 2
    for i in range(2):
        for k in range(3):
            h.cov[2, i, k] *= -e
            h.cov[2, k, i] *= -e
    h.cov[2, 0, 0] += ((1.0 + e) * scene.surface_sigma) ** 2
    h.cov[2, 1, 1] += (BOUNCE_JITTER + surface.restitution_sigma * speed) ** 2
    for axis in range(3):
        h.cov[axis, 2, 2] += slack_spread(h, scene) ** 2
