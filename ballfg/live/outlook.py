"""Predicts a ball's next bounce, its apex and the crossing of a plane, without exceptions."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from pydantic_core import to_json

from ballfg.arrays import Array
from ballfg.estimation.online.state import OnlineState
from ballfg.estimation.result import Status
from ballfg.live.tracker import BallUpdate
from ballfg.prediction import BallState
from ballfg.prediction.crossing import Crossing
from ballfg.prediction.event_ahead import EventAhead, contact_ahead, event_on
from ballfg.prediction.forecast import carried_by
from ballfg.prediction.path import Path
from ballfg.prediction.plane import APEX, CONTACT, Plane
from ballfg.state import POSITION, SPIN, VELOCITY

VAGUE = 3.0  # m/s, standard deviation of the velocity beyond which predictions carry no information


@dataclass(frozen=True)
class Outlook:
    """Events ahead of a ball.

    bounce: the next contact, apex: the next highest point, crossing: of the plane; None without one within the horizon.
        probability: of each by its name, where a plane was asked for.
        note: reason for a missing prediction; empty without one.
    """

    bounce: Crossing | None = None
    apex: Crossing | None = None
    crossing: Crossing | None = None
    note: str = ""
    probability: Mapping[str, float] | None = None


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
            finders = _finders(state, horizon, plane)
        except Exception as error:  # a prediction must not end the stream
            return Outlook(note=f"no prediction: {_one_line(error)}")
        found = {what: _tried(find, what, notes) for what, find in finders.items()}
    chances = None if plane is None else {what: event.probability for what, event in found.items()}
    return Outlook(
        **{what: event.crossing for what, event in found.items()}, note="; ".join(notes), probability=chances
    )


def _finders(state: OnlineState, horizon: float, plane: Plane | None) -> dict[str, Callable[[], EventAhead]]:
    """What finds each event. Probabilities always need possible balls, so they are given where a plane is asked for."""
    path = Path(state, carried_by(state), horizon)
    if plane is None:
        return {
            "bounce": lambda: EventAhead(*contact_ahead(path)),
            "apex": lambda: EventAhead(path.apex(), math.nan),
        }
    asked: dict[str, Plane | str] = {"bounce": CONTACT, "apex": APEX, "crossing": plane}
    return {what: partial(event_on, path, event) for what, event in asked.items()}


def unusable(state: BallState) -> str:
    """The reason why a state allows no prediction; empty if it does."""
    if isinstance(state, OnlineState) and state.status is not Status.OK:
        return f"no prediction: {state.status.value}"
    variances = np.diagonal(state.joint)
    if not (np.isfinite(state.mean).all() and np.isfinite(variances).all() and (variances >= 0.0).all()):
        return "no prediction: the state is not finite"
    if _is_vague(variances):
        struck = state.struck if isinstance(state, OnlineState) else None
        if struck is not None and not _is_vague(np.maximum(variances - np.diagonal(struck), 0.0)):
            return "no prediction: this position is an outlier or follows a hit, as the next ones will tell"
        return f"no prediction: the velocity is not known to {VAGUE:g} m/s yet"
    return ""


def _is_vague(variances: Array) -> bool:
    """Whether predictions carry no information: of a state's variances (d,)."""
    return float(np.sqrt(variances[VELOCITY]).max()) > VAGUE


def _tried(find: Callable[[], EventAhead], what: str, notes: list[str]) -> EventAhead:
    try:
        found = find()
    except Exception as error:
        notes.append(f"no {what}: {_one_line(error)}")
        return EventAhead(None, math.nan)
    mean = found.crossing
    if mean is not None and not (math.isfinite(mean.time) and np.isfinite(mean.state).all()):
        notes.append(f"no {what}: it is not finite")
        return EventAhead(None, math.nan)
    return found


def _one_line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:200]


Fields = dict[str, Any]
KINDS = ("state", "newcomer", "lost", "refused", "continued")
"""Kinds of lines; the last one marks where a command continued an earlier recording."""


def answer(update: BallUpdate, outlook: Outlook | None, tag: tuple[tuple[str, Any], ...]) -> Fields:
    """The fields of a line. Args: outlook: None for a line without state. tag: further fields, from the input."""
    fields: Fields = {"kind": update.kind}
    if update.ball is not None:
        fields["ball"] = update.ball
    if update.kind == "lost":
        return fields | {"t": update.time, "samples": update.samples}
    if update.kind == "state" and update.state is not None and outlook is not None:
        fields |= _state(update, outlook)
    else:
        fields |= {"t_input": update.time}
        fields |= {"samples": update.samples} if update.samples else {}
        fields |= {"reason": update.reason} if update.reason else {}
    if update.position is not None:
        fields["measured"] = update.position.tolist()
    return fields | dict(tag)


def refusal(reason: str) -> Fields:
    """The fields of a line about an unreadable input line."""
    return {"kind": "refused", "reason": reason}


def encoded(fields: Fields, latency: float) -> bytes:
    """A line with its latency, ms; numbers that are not finite are null, since JSON has none."""
    return b'%b,"latency_ms":%.3f}\n' % (to_json(fields, inf_nan_mode="null")[:-1], latency)


def _state(update: BallUpdate, outlook: Outlook) -> Fields:
    state = update.state
    assert state is not None
    chances = outlook.probability
    return {
        "t": state.time,
        "t_input": update.time,
        "late": update.late,
        "samples": update.samples,
        "status": state.status.name.lower(),
        "position": state.mean[POSITION].tolist(),
        "velocity": state.mean[VELOCITY].tolist(),
        "spin": state.mean[SPIN].tolist(),
        "covariance": state.covariance.tolist(),
        "innovation": state.innovation.tolist() if np.isfinite(state.innovation).all() else None,
        "events": [
            {"kind": e.kind, "t": e.time} | ({} if e.height is None else {"z": e.height}) for e in update.events
        ],
        "bounce": _crossing(outlook.bounce),
        "apex": _crossing(outlook.apex),
        "crossing": _crossing(outlook.crossing),
        "probability": chances,
        "note": "; ".join(text for text in (update.reason, outlook.note) if text),
    }


def _crossing(event: Crossing | None) -> Fields | None:
    if event is None:
        return None
    return {
        "t": event.time,
        "sigma_t": event.time_sigma,
        "state": event.state.tolist(),
        "sigma": np.sqrt(np.maximum(np.diagonal(event.covariance), 0.0)).tolist(),
    }
