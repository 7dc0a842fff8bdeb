"""Writes one JSON line for each incoming position and for each lost ball."""

import json
import math
from typing import Any

import numpy as np

from ballfg.arrays import Array
from ballfg.live.outlook import Outlook
from ballfg.live.tracker import BallUpdate
from ballfg.prediction.crossing import Crossing
from ballfg.state import POSITION, SPIN, VELOCITY

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
        fields |= {"t_input": _number(update.time)}
        fields |= {"samples": update.samples} if update.samples else {}
        fields |= {"reason": update.reason} if update.reason else {}
    if update.position is not None:
        fields["measured"] = _numbers(update.position)
    return fields | dict(tag)


def refusal(reason: str) -> Fields:
    """The fields of a line about an unreadable input line."""
    return {"kind": "refused", "reason": reason}


def encoded(fields: Fields, latency: float) -> bytes:
    """A line with its latency, ms."""
    text = json.dumps(fields, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return f'{text[:-1]},"latency_ms":{latency:.3f}}}\n'.encode()


def _state(update: BallUpdate, outlook: Outlook) -> Fields:
    state = update.state
    assert state is not None
    return {
        "t": state.time,
        "t_input": update.time,
        "late": update.late,
        "samples": update.samples,
        "status": state.status.name.lower(),
        "position": _numbers(state.mean[POSITION]),
        "velocity": _numbers(state.mean[VELOCITY]),
        "spin": _numbers(state.mean[SPIN]),
        "covariance": [_numbers(row) for row in state.covariance],
        "innovation": _numbers(state.innovation) if np.isfinite(state.innovation).all() else None,
        "events": [
            {"kind": e.kind, "t": e.time} | ({} if e.height is None else {"z": e.height}) for e in update.events
        ],
        "bounce": _crossing(outlook.bounce),
        "apex": _crossing(outlook.apex),
        "crossing": _crossing(outlook.crossing),
        "note": "; ".join(text for text in (update.reason, outlook.note) if text),
    }


def _crossing(event: Crossing | None) -> Fields | None:
    if event is None:
        return None
    return {
        "t": event.time,
        "sigma_t": _number(event.time_sigma),
        "state": _numbers(event.state),
        "sigma": _numbers(np.sqrt(np.maximum(np.diagonal(event.covariance), 0.0))),
    }


def _numbers(values: Array) -> list[float | None]:
    """Numbers for JSON, which has no NaN."""
    return [_number(x) for x in values.tolist()]


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
