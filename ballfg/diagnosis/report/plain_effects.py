"""Effects in everyday words: a short name of each, and a sentence with its numbers for readers who are no specialists.

`PLAIN` is the registry. An effect that is not in it, such as a user's own, gets its name with spaces and its own
`sentence`.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from ballfg.diagnosis.report.wording import listed, plus_minus
from ballfg.diagnosis.result import Finding, Value

Values = Mapping[str, Value]
MOSTLY_ALONG: Final = 0.9
"""Share of a vector's length along one axis from which it is said to point along that axis."""
BY_GROUP, DRIFT = "_by_group", "_drift"
"""Ends of the names of effects that differ between groups of tracks, or change along the recording."""


@dataclass(frozen=True)
class Plain:
    """An effect in everyday words.

    Attributes:
        name: a noun, such as `a wind`.
        says: from the coefficients as fitted to a sentence with their sizes.
    """

    name: str
    says: Callable[[Values], str]


def plain_name(effect: str) -> str:
    """An effect as a noun: `a wind`; of an unknown effect its name with spaces."""
    for ending, words in ((BY_GROUP, "different from group to group"), (DRIFT, "changing along the recording")):
        if effect.endswith(ending):
            return f"{plain_name(effect.removesuffix(ending))}, {words}"
    return PLAIN[effect].name if effect in PLAIN else effect.replace("_", " ")


def in_plain_words(finding: Finding) -> str:
    """A sentence on an effect and its size. Of an unknown effect: its own first sentence and its coefficients."""
    if finding.name in PLAIN:
        return PLAIN[finding.name].says(finding.parameters)
    for ending, words in ((BY_GROUP, "differs between groups of tracks"), (DRIFT, "changes along the recording")):
        if finding.name.endswith(ending):
            whole = plain_name(finding.name.removesuffix(ending))
            levels = (f"{_level(name)} {plus_minus(value)}" for name, value in finding.parameters.items())
            return f"{whole[:1].upper()}{whole[1:]} {words}: {', '.join(levels)}."
    said = finding.sentence.partition(". ")[0].rstrip(".")
    return f"{said} ({listed(finding.parameters)})." if finding.parameters else f"{said}."


def _level(name: str) -> str:
    """`topspin` of `k[topspin]`; with the axis of a coefficient that has several: `topspin x`."""
    coefficient, _, level = name.partition("[")
    return f"{level.removesuffix(']')} {coefficient}" if coefficient in ("x", "y", "z") else level.removesuffix("]")


def size(values: Values) -> float:
    """Length of the vector x, y, z."""
    return math.hypot(*(values[axis].value for axis in "xyz" if axis in values))


def direction(values: Values) -> str:
    """For instance `along x`, `along -y`, or the components where no axis is nearly the vector's."""
    parts = {axis: values[axis] for axis in "xyz" if axis in values}
    axis, largest = max(parts.items(), key=lambda item: abs(item[1].value))
    if abs(largest.value) >= MOSTLY_ALONG * size(values):
        return f"along {'-' if largest.value < 0 else ''}{axis}"
    return "with " + ", ".join(f"{name} {value.value:.2g}" for name, value in parts.items())


def _more(value: Value, more: str, less: str) -> str:
    return more if value.value >= 0.0 else less


def _percent(value: Value) -> str:
    return f"{100 * abs(value.value):.2g} %"


def _milli(value: Value) -> str:
    return f"{1e3 * abs(value.value):.2g}"


def _degrees(values: Values) -> str:
    return f"{math.degrees(size(values)):.2g}°"


def _scale(values: Values) -> str:
    clear = {a: v for a, v in values.items() if abs(v.value) > 2.0 * v.sigma} or values
    parts = (f"{_percent(v)} too {_more(v, 'long', 'short')} along {axis}" for axis, v in clear.items())
    return f"Measured lengths are {', '.join(parts)}."


def _time_offset(values: Values) -> str:
    offsets = [values[axis].value if axis in values else 0.0 for axis in "xyz"]
    apart = max(offsets) - min(offsets)
    return f"The coordinates of one position are taken at different moments, up to {1e3 * apart:.2g} ms apart."


PLAIN: Final[Mapping[str, Plain]] = {
    "gravity": Plain("the ball's weight", lambda v: f"The ball is pulled down with {v['g'].value:.3g} m/s²."),
    "buoyancy": Plain(
        "a lift by the displaced air",
        lambda v: f"Something carries a part of the ball's weight: {abs(v['a'].value):.2g} m/s² of acceleration.",
    ),
    "drag": Plain("air drag", lambda v: f"The air brakes the ball (drag coefficient {v['k'].value:.3g} 1/m)."),
    "drag_speed": Plain(
        "a drag that changes with speed",
        lambda v: (
            f"The drag coefficient {_more(v['slope'], 'grows', 'falls')} with the ball's speed, "
            f"by {_percent(v['slope'])} for each m/s."
        ),
    ),
    "drag_spin": Plain(
        "a drag that changes with spin",
        lambda v: (
            f"A ball that spins has {_more(v['gain'], 'more', 'less')} drag: {_percent(v['gain'])} at a spin "
            "whose surface speed equals the flight speed."
        ),
    ),
    "magnus": Plain(
        "a force by spin (Magnus force)",
        lambda v: f"Spin bends the flight (Magnus coefficient {v['k'].value:.3g}).",
    ),
    "magnus_saturation": Plain(
        "a force by spin that saturates",
        lambda v: "The sideways force of a spinning ball grows more slowly than its spin.",
    ),
    "spin_decay": Plain(
        "a spin that fades in flight",
        lambda v: f"The spin fades in flight, by {100 * -math.expm1(-v['rate'].value):.2g} % in one second.",
    ),
    "wind": Plain("a wind", lambda v: f"The air moves at {size(v):.2g} m/s {direction(v)}."),
    "wind_shear": Plain(
        "a wind that grows with height",
        lambda v: f"The air moves faster higher up: {size(v):.2g} m/s more for each metre, {direction(v)}.",
    ),
    "gust_region": Plain(
        "a wind in one part of the room",
        lambda v: f"In one part of the room the air moves at {size(v):.2g} m/s {direction(v)}.",
    ),
    "restitution": Plain(
        "a bounce that loses speed",
        lambda v: f"The ball leaves the table with {_percent(v['e'])} of its vertical speed.",
    ),
    "restitution_speed": Plain(
        "a bounce that depends on the impact's speed",
        lambda v: (
            f"Faster impacts bounce {_more(v['slope'], 'less', 'more')}: the share of vertical speed that is kept "
            f"{_more(v['slope'], 'falls', 'grows')} by {100 * abs(v['slope'].value):.2g} points for each m/s."
        ),
    ),
    "friction": Plain(
        "friction at the bounce", lambda v: f"The table rubs on the ball (friction {v['mu'].value:.2g})."
    ),
    "tangential_restitution": Plain(
        "a grip at the bounce that springs back",
        lambda v: f"The table grips the ball and throws back {_percent(v['e_t'])} of its slip.",
    ),
    "table_height": Plain(
        "a table at another height",
        lambda v: (
            f"The table is {_milli(v['offset'])} mm {_more(v['offset'], 'higher', 'lower')} than the dataset says."
        ),
    ),
    "table_tilt": Plain("a table that is not level", lambda v: f"The table is not level: it leans by {_degrees(v)}."),
    "time_offset": Plain("cameras that are not synchronous", _time_offset),
    "velocity_lag": Plain(
        "positions that are reported late",
        lambda v: f"Positions are reported {_milli(v['lag'])} ms too {_more(v['lag'], 'late', 'early')}.",
    ),
    "frame_tilt": Plain(
        "axes that are not level",
        lambda v: f"The axes of the measurements lean by {_degrees(v)} against the vertical.",
    ),
    "scale": Plain("lengths that are wrong by a factor", _scale),
    "radial_bias": Plain(
        "positions pushed away from one place",
        lambda v: (
            f"Positions lie {_milli(v['offset'])} mm too {_more(v['offset'], 'far from', 'near to')} one place, "
            "such as a camera."
        ),
    ),
    "distortion": Plain(
        "positions stretched as by a lens", lambda v: "Positions are stretched by place, as by a badly calibrated lens."
    ),
    "time_scale": Plain(
        "a clock that runs wrong",
        lambda v: f"The clock is wrong: durations are written {_percent(v['s'])} too {_more(v['s'], 'long', 'short')}.",
    ),
    "counted_frames": Plain(
        "stamps that miss dropped frames",
        lambda v: f"The stamps count frames although frames were dropped, {v['missing'].value:.2g} for each one kept.",
    ),
    "spin_label_frame": Plain(
        "spin labels in other axes",
        lambda v: "The spin labels are given in other axes, or with other signs, than the positions.",
    ),
    "spin_label_scale": Plain(
        "spin labels wrong by a factor",
        lambda v: f"The spin labels are {_percent(v['s'])} too {_more(v['s'], 'large', 'small')}.",
    ),
    "spin_label_offset": Plain(
        "spin labels wrong by a constant",
        lambda v: f"All spin labels are off by the same {size(v):.2g} rad/s {direction(v)}.",
    ),
    "tracker_memory": Plain(
        "a tracker whose errors last",
        lambda v: (
            f"The tracker's errors last from sample to sample: {_milli(v['sigma'])} mm that fade over "
            f"{_milli(v['time'])} ms."
        ),
    ),
    "stamp_jitter": Plain(
        "time stamps that jitter", lambda v: f"The time stamps jitter by {_milli(v['sigma'])} ms from sample to sample."
    ),
}
"""Every effect of the catalogue, and the two properties of a tracker that a diagnosis finds."""
