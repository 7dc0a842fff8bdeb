"""Contacts: a hypothesis that may meet a surface branches: it did not, it bounced, it stayed down."""

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.estimation.segmentation.bank import FLYING, Bank, concatenate
from ballfg.estimation.segmentation.events import Event, EventKind
from ballfg.estimation.segmentation.kernels import SLOWEST_CLOSING
from ballfg.estimation.segmentation.motion import carry, fly, put_down
from ballfg.estimation.segmentation.scene import Scene

LEAST_FALL = 0.05
"""m/s. A path that meets a surface more slowly grazes it: no contact."""
POSITION_JITTER = 1e-3
"""m, by which the horizontal position is less certain after a contact."""
KNOWN_SPEED = 1.0
"""m/s. A path whose vertical speed is less certain, as after a single sample, is not said to land slowly."""
BOUNCE_JITTER = 0.03
"""m/s, of the normal velocity after a bounce, whatever its speed."""
SLIDE_JITTER = 0.05
"""m/s, of the tangential velocity, likewise."""
WEAKEST_FALL = 0.2
"""Share of gravity below which the slack is not believed to hold the ball up."""


def step(bank: Bank, dt: float, scene: Scene, interval: int, start: float, *, strict: bool) -> Bank:
    """All hypotheses after dt s, branched at the contacts that may have happened.

    Args:
        bank: hypotheses at time `start`.
        dt: s.
        scene: ball, surfaces, settings.
        interval: index of the interval that this step is, or is a part of.
        start: s, on the track's clock.
        strict: only contacts inside the step; otherwise also such as the uncertainty of the path lets in. Parts of an
            interval are strict, or each contact would be tried by two of them.
    """
    free = carry(bank, dt, scene)
    branches = [free]
    for surface in _near(free, scene):
        times, speeds, ok = _meetings(bank, surface, dt, scene, strict=strict)
        rows = np.flatnonzero(ok)
        if len(rows):
            times = times[rows]
            landed = _touch(bank.take(rows), times, surface, scene, interval, start)
            slow = np.flatnonzero(
                (speeds[rows] < scene.settings.rest_speed) & (landed.cov[:, 2, 1, 1] < KNOWN_SPEED**2)
            )
            if len(slow):
                branches.append(_stay(landed.take(slow), dt - times[slow], surface, scene, interval, start + dt))
            branches.append(_bounce(landed, dt - times, surface, scene))
    return concatenate(branches)


def _near(after: Bank, scene: Scene) -> list[int]:
    """The surfaces that some hypothesis, flown on without contact, would have met by now or within the window."""
    mean = after.mean[:, 2]
    low = mean[:, 0] - after.shift[:, 2] + scene.settings.contact_window * np.minimum(mean[:, 1], -SLOWEST_CLOSING)
    lowest = float(low.min())
    return [surface for surface, centre in enumerate(scene.centres.tolist()) if lowest < centre]


def _meetings(
    bank: Bank, surface: int, dt: float, scene: Scene, *, strict: bool
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Time (h,) s and speed (h,) m/s at which each mean path comes down to a surface, and whether it is to be tried."""
    height = bank.mean[:, 2, 0] - bank.shift[:, 2] - scene.centres[surface]
    rise = bank.mean[:, 2, 1]
    gravity = scene.physics.gravity
    velocity = bank.mean[:, :, 1]
    drag = scene.physics.drag * np.sqrt(np.einsum("ha,ha->h", velocity, velocity))
    pull = np.maximum(gravity - bank.mean[:, 2, 2] + drag * rise, WEAKEST_FALL * gravity)
    speed = np.sqrt(np.maximum(rise * rise + 2.0 * pull * height, 0.0))  # zero where the path stays below
    time = (rise + speed) / pull
    ok = (bank.surface == FLYING) & (speed > LEAST_FALL)
    ok &= scene.reaches(surface, bank.mean[:, :2, 0] - bank.shift[:, :2] + bank.mean[:, :2, 1] * time[:, None])
    if strict:
        ok &= (time >= 0.0) & (time < dt)
    else:
        reach = 3.0 * np.sqrt(bank.cov[:, 2, 0, 0]) + 2.0 * scene.settings.surface_sigma
        margin = np.minimum(reach / np.maximum(speed, SLOWEST_CLOSING), scene.settings.contact_window)
        # one sample between two contacts, or one contact would be tried in two intervals running
        ok &= (time > -margin) & (time < dt + margin) & (bank.age >= 1)
    return time, speed, ok


def _touch(bank: Bank, times: Array, surface: int, scene: Scene, interval: int, start: float) -> Bank:
    """The hypotheses just before their contacts, priced and with the event; changes and returns the bank."""
    bank.mean, bank.cov = fly(bank.mean, bank.cov, times, scene)
    bank.score -= scene.settings.contact_cost
    bank.age[:] = 0
    for row, time in enumerate(times.tolist()):
        bank.add_event(row, Event(EventKind.CONTACT, interval, start + time, scene.height(surface)))
    return bank


def _bounce(bank: Bank, rest_of_step: Array, surface: int, scene: Scene) -> Bank:
    """Hypotheses at a contact, bounced and flown on: mirrored in z, slowed by the friction of an unknown spin.

    Friction changes the tangential velocity by mu (1 + e) v_n at most, either way: half of that is expected, but no
    more than a ball without spin would lose, and half is the spread.
    """
    settings = scene.settings
    e = scene.physics.restitution
    mean, cov = bank.mean, bank.cov
    speed = np.abs(mean[:, 2, 1])
    friction = 0.5 * scene.physics.friction * (1.0 + e) * speed
    sliding = np.maximum(np.hypot(mean[:, 0, 1], mean[:, 1, 1]), SLOWEST_CLOSING)
    keep = 1.0 - np.minimum(friction / sliding, settings.most_slowing)
    mean[:, :2, 1] *= keep[:, None]
    mean[:, 2, 1] = e * speed
    mean[:, 2, 0] = scene.centres[surface] + bank.shift[:, 2]
    # the Jacobian is diagonal: (1, keep, 1) along the surface, (-e, -e, 1) along its normal, for late or early paths
    J = np.ones((len(bank), 3, 3))
    J[:, :2, 1] = keep[:, None]
    J[:, 2, :2] = -e
    cov *= J[..., :, None] * J[..., None, :]
    cov[:, :2, 0, 0] += POSITION_JITTER**2
    cov[:, :2, 1, 1] += (SLIDE_JITTER + friction[:, None]) ** 2
    cov[:, 2, 0, 0] += ((1.0 + e) * settings.surface_sigma) ** 2
    cov[:, 2, 1, 1] += (BOUNCE_JITTER + scene.restitution_sigmas[surface] * speed) ** 2
    cov[:, :, 2, 2] += settings.slack_at_contact**2
    bank.mean, bank.cov = fly(mean, cov, rest_of_step, scene)
    return bank


def _stay(bank: Bank, rest_of_step: Array, surface: int, scene: Scene, interval: int, time: float) -> Bank:
    """Hypotheses at a contact that stay down for the rest of the step."""
    put_down(bank, np.full(len(bank), surface), scene)
    height_mean, height_cov = bank.mean[:, 2].copy(), bank.cov[:, 2].copy()
    bank.mean, bank.cov = fly(bank.mean, bank.cov, rest_of_step, scene)
    bank.mean[:, 2], bank.cov[:, 2] = height_mean, height_cov
    bank.score -= scene.settings.rest_cost
    for row in range(len(bank)):
        bank.add_event(row, Event(EventKind.REST, interval, time, scene.height(surface)))
    return bank
