"""Predicts a ball's next bounce, its apex and the crossing of a plane, without exceptions."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ballfg.checks import shown
from ballfg.estimation.online.state import OnlineState
from ballfg.estimation.result import Status
from ballfg.prediction import BallState, apex, next_contact, plane_crossing
from ballfg.prediction.crossing import Crossing
from ballfg.prediction.forecast import carried_by
from ballfg.state import VELOCITY

VAGUE = 3.0  # m/s, standard deviation of the velocity beyond which predictions carry no information
AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Outlook:
    """Events ahead of a ball.

    bounce: the next contact, apex: the next highest point, crossing: of the plane; None without one within the horizon.
        note: reason for a missing prediction; empty without one.
    """

    bounce: Crossing | None = None
    apex: Crossing | None = None
    crossing: Crossing | None = None
    note: str = ""


@dataclass(frozen=True)
class Plane:
    """A plane across one axis. Attributes: axis: x, y or z. place: m."""

    axis: str
    place: float

    @property
    def normal(self) -> tuple[float, ...]:
        """(3,) dimensionless."""
        return tuple(float(axis == self.axis) for axis in AXES)

    @classmethod
    def parse(cls, text: str) -> Plane:
        """The plane of a text such as x=2.0. Raises: ValueError: any other text."""
        found = re.fullmatch(r"\s*([xyz])\s*=\s*(\S+)\s*", text)
        try:
            place = float(found[2]) if found else math.nan
        except ValueError:
            place = math.nan
        if found is None or not math.isfinite(place):
            raise ValueError(f"plane must be an axis and a place in m; got {shown(text)}. Write x=2.0, for instance.")
        return cls(found[1], place)


def look_out(state: OnlineState, horizon: float, plane: Plane | None) -> Outlook:
    """The events ahead of a state; the note names events that cannot be predicted.

    Args: horizon: s.  plane: to cross, or None.
    """
    doubt = unusable(state)
    if doubt:
        return Outlook(note=doubt)
    notes: list[str] = []
    with np.errstate(all="ignore"):
        try:
            carried = carried_by(state)
        except Exception as error:  # a prediction must not end the stream
            return Outlook(note=f"no prediction: {_one_line(error)}")
        bounce = _tried(lambda: next_contact(*carried, horizon), "bounce", notes)
        top = _tried(lambda: apex(*carried, horizon), "apex", notes)
        crossing = None
        if plane is not None:
            across, place = plane.normal, plane.place
            crossing = _tried(lambda: plane_crossing(*carried, across, place, horizon), "crossing", notes)
    return Outlook(bounce, top, crossing, "; ".join(notes))


def unusable(state: BallState) -> str:
    """The reason why a state allows no prediction; empty if it does."""
    if isinstance(state, OnlineState) and state.status is not Status.OK:
        return f"no prediction: {state.status.value}"
    variances = np.diagonal(state.joint)
    if not (np.isfinite(state.mean).all() and np.isfinite(variances).all() and (variances >= 0.0).all()):
        return "no prediction: the state is not finite"
    if float(np.sqrt(variances[VELOCITY]).max()) > VAGUE:
        return f"no prediction: the velocity is not known to {VAGUE:g} m/s yet"
    return ""


def _tried(find: Callable[[], Crossing | None], what: str, notes: list[str]) -> Crossing | None:
    try:
        found = find()
    except Exception as error:
        notes.append(f"no {what}: {_one_line(error)}")
        return None
    if found is not None and not (math.isfinite(found.time) and np.isfinite(found.state).all()):
        notes.append(f"no {what}: it is not finite")
        return None
    return found


def _one_line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:200]
