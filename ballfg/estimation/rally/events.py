"""Finds the events of a rally: hits, bounces, net, floor, where the ball is lost; and the numbers of each stroke."""

from dataclasses import replace
from typing import Final

import numpy as np
from scipy.special import ndtr

from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.rally.moments import Event, Moment, carried
from ballfg.estimation.rally.reconstruct import ShotRally
from ballfg.estimation.result import Estimate
from ballfg.state import POSITION, SPIN, STANDARD_GRAVITY, STATE_DIM, VELOCITY, VZ, Z

BEHIND: Final = (0.2, 0.25)
"""m behind the end of the court where a first stroke is hit, and its standard deviation."""
LANDS: Final = 2.0
"""Pictures after the last sighting in which a ball that is not hit meets the floor, or the net."""
TOUCHES: Final = 0.5
"""Least probability of a touch of the net that is an event."""


def events_of(one: ShotRally, model: BallModel, surfaces: Surfaces, step: float) -> list[Event]:
    """Hits between two strokes, bounces, and where balls end, in order of time. Args: step: s between pictures."""
    found = list[Event]()
    for number, (estimate, chance) in enumerate(zip(one.estimates, one.chosen.probabilities.tolist(), strict=True)):
        hit = one.hits[number]
        if hit is not None:
            both = chance * float(one.chosen.probabilities[number - 1])
            found.append(replace(hit, trajectory=estimate.name, probability=both))
        found += [replace(event, probability=chance) for event in bounces_of(model, estimate)]
        if _ends(one, number):
            found.append(replace(end_of(model, estimate, surfaces, step), probability=chance))
    return sorted(found, key=lambda event: event.t)


def events_in_play(one: ShotRally, model: BallModel, surfaces: Surfaces, step: float, net: float) -> list[Event]:
    """The events of a rally in order of time, with the hits of first strokes and the net.

    Args: step: s between pictures.  net: m, its height at x = 0; 0: none.
    """
    found = events_of(one, model, surfaces, step)
    for number, (estimate, chance) in enumerate(zip(one.estimates, one.chosen.probabilities.tolist(), strict=True)):
        if one.hits[number] is None:
            found.append(replace(first_hit(model, estimate, surfaces, step), probability=chance))
        beyond = LANDS * step if _ends(one, number) else 0.0
        touches = net_touches(model, estimate, surfaces, net, beyond)
        found += [replace(touch, probability=chance * touch.probability) for touch in touches]
    return sorted(found, key=lambda event: event.t)


def _ends(one: ShotRally, number: int) -> bool:
    """True if no stroke follows that a hit joins to this one."""
    return number == len(one.estimates) - 1 or not one.chosen.joined[number + 1]


def bounces_of(model: BallModel, estimate: Estimate) -> list[Event]:
    """The bounces of a stroke, from the states before them."""
    found = list[Event]()
    for contact in estimate.contacts:
        sample = max(int(np.searchsorted(estimate.times, contact.time, side="right")) - 1, 0)
        at = carried(model, estimate, sample, contact.time)
        fall = max(abs(float(at.state[VZ])), 0.1)
        sigma_t = float(np.sqrt(at.covariance[Z, Z])) / fall
        slip = np.eye(STATE_DIM)[POSITION]  # on the surface, whenever it is met
        slip[:2, Z] = -at.state[VELOCITY][:2] / at.state[VZ] if abs(at.state[VZ]) > 0.1 else 0.0
        sigmas = np.sqrt(np.diag(slip @ at.covariance @ slip.T))
        found.append(
            Event(estimate.name, at.t, "bounce", at.state[POSITION], sigma_t, np.append(sigmas[:2], 1e-3), 1.0)
        )
    return found


def first_hit(model: BallModel, estimate: Estimate, surfaces: Surfaces, step: float) -> Event:
    """The hit of a stroke that follows none: behind the end of the court that the ball comes from."""
    x, speed = float(estimate.states[0, 0]), float(estimate.states[0, VELOCITY][0])
    ends = surfaces.extent or (-np.inf, np.inf, -np.inf, np.inf)
    behind = ends[0] - BEHIND[0] if speed > 0.0 else ends[1] + BEHIND[0]
    back = (x - behind) / speed if np.isfinite(behind) and abs(speed) > 0.5 else 0.5 * step
    back, sigma_t = max(back, 0.5 * step), max(BEHIND[1] / max(abs(speed), 0.5), 0.5 * step)
    at = carried(model, estimate, 0, float(estimate.times[0]) - back)
    spread = at.covariance[POSITION, POSITION] + sigma_t**2 * np.outer(at.state[VELOCITY], at.state[VELOCITY])
    return Event(estimate.name, at.t, "hit", at.state[POSITION], sigma_t, np.sqrt(np.diag(spread)), 1.0)


def stroke_row(estimate: Estimate, events: list[Event], model: BallModel, net: float) -> dict[str, float | str]:
    """The numbers of a stroke, with sigmas; NaN where it does not show one.

    Args: events: of the shot.  net: m, height of the net at x = 0.
    """
    mine = [event for event in events if event.trajectory == estimate.name]
    hit = next(event for event in mine if event.kind == "hit")
    bounces = [event for event in mine if event.kind == "bounce"]
    start = carried(model, estimate, 0, hit.t)
    row: dict[str, float | str] = {"stroke": estimate.name, "t_start": hit.t, "t_end": float(estimate.times[-1])}
    row["end"] = "+x" if start.state[VELOCITY][0] < 0.0 else "-x"
    row |= _speed("speed_hit", start)
    nothing = Moment(0.0, np.full(STATE_DIM, np.nan), np.full((STATE_DIM, STATE_DIM), np.nan))
    before = nothing
    if bounces:
        sample = max(int(np.searchsorted(estimate.times, bounces[0].t, side="right")) - 1, 0)
        before = carried(model, estimate, sample, bounces[0].t)
    row |= _speed("speed_bounce", before)
    for axis, number in zip("xyz", range(SPIN.start, SPIN.stop), strict=True):
        row[f"spin_{axis}"] = float(start.state[number])
        row[f"sigma_spin_{axis}"] = float(np.sqrt(start.covariance[number, number]))
    over = _crossing(model, estimate)  # of the ball's lowest point, where it crosses the net
    row["net_clearance"] = np.nan if over is None else float(over.state[Z]) - net - model.radius
    row["sigma_net_clearance"] = np.nan if over is None else float(np.sqrt(over.covariance[Z, Z]))
    place = bounces[-1].place if bounces else np.full(3, np.nan)
    sigmas = bounces[-1].sigmas if bounces else np.full(3, np.nan)
    for i, axis in enumerate("xy"):
        row[f"bounce_{axis}"], row[f"sigma_bounce_{axis}"] = float(place[i]), float(sigmas[i])
    return row | {"status": estimate.status.name.lower()}


def _speed(name: str, moment: Moment) -> dict[str, float]:
    """A speed, m/s, and its sigma."""
    velocity = moment.state[VELOCITY]
    speed = float(np.linalg.norm(velocity))
    unit = velocity / max(speed, 1e-9)
    return {name: speed, f"sigma_{name}": float(np.sqrt(unit @ moment.covariance[VELOCITY, VELOCITY] @ unit))}


def _crossing(model: BallModel, estimate: Estimate, beyond: float = 0.0) -> Moment | None:
    """The ball where it first crosses x = 0, at most so many s beyond its last sample."""
    x, crossed = estimate.states[:, 0], np.flatnonzero(np.diff(np.sign(estimate.states[:, 0])) != 0)
    sample = int(crossed[0]) if len(crossed) else len(x) - 1
    speed = float(estimate.states[sample, VELOCITY][0])
    ahead = -float(x[sample]) / speed if speed else np.inf
    if not len(crossed) and not 0.0 <= ahead <= beyond:
        return None
    return carried(model, estimate, sample, float(estimate.times[sample]) + ahead)


def net_touches(model: BallModel, estimate: Estimate, surfaces: Surfaces, net: float, beyond: float) -> list[Event]:
    """The touch of the net, if one is likelier than none: the ball's lowest point passes x = 0 below the net's edge.

    Args: net: m, its height; 0 for none.  beyond: s after the last sample in which the ball may meet it.
    """
    at = _crossing(model, estimate, beyond) if net > 0.0 else None
    if at is None:
        return []
    reach = net + (surfaces.extent[3] if surfaces.extent else np.inf)  # posts stand as far outside as the net is high
    sigmas = np.sqrt(np.diag(at.covariance))
    chance = float(ndtr((net + model.radius - at.state[Z]) / sigmas[Z]))
    if abs(at.state[1]) > reach or chance < TOUCHES:
        return []
    sigma_t = float(sigmas[0] / max(abs(at.state[VELOCITY][0]), 0.1))
    return [Event(estimate.name, at.t, "net", at.state[POSITION], sigma_t, sigmas[POSITION], chance)]


def end_of(model: BallModel, estimate: Estimate, surfaces: Surfaces, step: float) -> Event:
    """The end of a stroke that no hit follows: on the floor, if it falls there at once, else where the ball is lost."""
    end = carried(model, estimate, -1, float(estimate.times[-1]))
    kind, sigma_t = "lost", step / 2.0
    if surfaces.floor_height is not None:
        height = float(end.state[Z]) - surfaces.floor_height - model.radius
        speed = float(end.state[VZ])
        fall = (speed + np.sqrt(max(speed**2 + 2.0 * STANDARD_GRAVITY * height, 0.0))) / STANDARD_GRAVITY
        if fall <= LANDS * step:
            end, kind = carried(model, estimate, -1, end.t + max(fall, 0.0)), "floor"
            sigma_t = float(np.sqrt(end.covariance[Z, Z])) / max(abs(float(end.state[VZ])), 0.1)
    sigmas = np.sqrt(np.diag(end.covariance))[POSITION]
    return Event(estimate.name, end.t, kind, end.state[POSITION], sigma_t, sigmas, 1.0)
