"""Determines the height of the table from the bounces of the balls, and the ball by its drag."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ballfg.arrays import MAD_TO_SIGMA, Array
from ballfg.dynamics import nominal_model
from ballfg.importing.choices import Choices, Guess
from ballfg.importing.frame import SURE, Frame
from ballfg.tracks import TABLE_TENNIS, Ball, Track
from ballfg.tracks.info import NO_SURFACE, TENNIS

_ARM: Final = 0.06  # s of flight for the fit on each side of a bounce
_LEAST_SAMPLES: Final = 3
_LEAST_SPEED: Final = 0.7  # m/s, of the fall before and the rise after a bounce; slower are rolling balls and noise
_MOST_RESIDUAL: Final = 0.02  # m, root mean square about the two flights; more means a hit, an outlier, or two balls
_SAME: Final = 0.04  # m: bounces within this distance of each other are on one surface
_SHARE: Final = 0.3  # of the most frequent surface's bounces that make a higher one the table: balls bounce on below it
_RESTITUTION: Final = np.linspace(0.15, 0.95, 17)  # of a surface: it is passive, a hand, a foot or a racket is not
_SPREAD: Final = 0.06  # standard deviation of the restitutions of bounces on one surface
_STRENGTHS: Final = np.array([0.1, 0.2, 0.35, 0.6])[:, None]  # of their logarithms, for hits
_ODD: Final = 0.1  # share of the turns near a surface's height that are none of its bounces
_LEVEL: Final = np.array([0.003, 0.006, 0.012])[:, None]  # m, standard deviations of the heights of its bounces
_UNEVEN: Final = np.array([0.01, 0.02, 0.04])[:, None]  # m, of those of hits that are near each other
_MOST_SWERVE: Final = 0.6  # friction changes the horizontal velocity by less than this share of the vertical change
_ROUGH: Final = 2.0  # standard deviations by which a court's friction may exceed that of the ball's model
_MOST_GAIN: Final = 0.2  # likewise of its growth, by topspin: at most 0.18 on five measured sets
_FEW: Final = 10  # number of bounces that shows a surface beside hits at other heights
_FEW_SHARE: Final = 0.5  # least share of all turns that fewer bounces are
_UNHANDLED: Final = 4.0  # nats for a surface where nothing else changes the motion
_REVERSED: Final = 1.0  # m/s, of a horizontal motion before and after a wall or a racket reverses it
_SURE: Final = 3.0  # nats by which bounces must explain the turns at a height better than hits
_GRAVITY: Final = 10.0  # m/s^2, of the fitted arcs: gravity and a little topspin. An error of 5 moves a bounce by 2 mm.
BALLS: Final = {"table-tennis": TABLE_TENNIS, "tennis": TENNIS}
_TENNIS_DRAG: Final = 0.045  # 1/m; halfway, in ratio, between the drags of the two balls
_SURE_WINDOWS: Final = 30  # number of flight parts from which their drag distinguishes the balls


@dataclass(frozen=True)
class Surface:
    """A height at which balls bounce."""

    centre: float  # m, of the ball's centre at contact, the median of the bounces
    spread: float  # m, standard deviation of one bounce
    bounces: int
    others: tuple[float, ...] = ()  # m, centres at further surfaces


@dataclass(frozen=True)
class Turn:
    """A flight that turns upwards at once, on a surface or by a hit."""

    height: float  # m, of the ball's centre
    restitution: float  # vertical speed after over that before
    swerve: float  # change of the horizontal velocity over that of the vertical one
    gain: float = 0.0  # likewise of its component forwards
    most_swerve: float = _MOST_SWERVE  # by a surface

    @property
    def bounce(self) -> bool:
        """True if something level and at rest can do it."""
        low, high = _RESTITUTION[0] - _SPREAD, _RESTITUTION[-1] + _SPREAD
        return bool(low <= self.restitution <= high and self.swerve <= self.most_swerve and self.gain <= _MOST_GAIN)


def surface(
    shots: Iterable[tuple[Array, Array]], handled: bool = False, most_swerve: float = _MOST_SWERVE
) -> Surface | None:
    """The surface of most bounces, or a higher one with nearly as many; of times (n,) s and positions (n, 3) m.

    Args: handled: True if hands or rackets also move the ball.  most_swerve: of a bounce, dimensionless.
    """
    shots = list(shots)
    turns = [turn for t, p in shots for turn in turns_of(t, p, most_swerve)]
    odd = sum(not turn.bounce for turn in turns) > _ODD * len(turns)
    prior = 0.0 if handled or odd or any(reverses(t, p) for t, p in shots) else _UNHANDLED
    left = sorted(turns, key=lambda turn: turn.height)
    groups: list[Array] = []
    while any(turn.bounce for turn in left):
        heights = np.array([turn.height for turn in left if turn.bounce])
        near = np.searchsorted(heights, heights + _SAME, side="right") - np.searchsorted(heights, heights - _SAME)
        middle = heights[int(np.argmax(near))]
        group = [turn for turn in left if abs(turn.height - middle) <= _SAME]
        bounces = np.array([turn.height for turn in group if turn.bounce])
        enough = len(bounces) >= min(_FEW, _FEW_SHARE * len(turns))
        if enough and evidence(group) + prior > _SURE:
            groups.append(bounces)
        left = [turn for turn in left if abs(turn.height - middle) > 2.0 * _SAME]
    if not groups:
        return None
    often = [group for group in groups if len(group) >= max(_SHARE * len(groups[0]), 1.0)]
    table = max(often, key=lambda group: float(np.median(group)))
    others = tuple(float(np.median(group)) for group in often if group is not table)
    return Surface(float(np.median(table)), _scatter(table), len(table), others)


def evidence(turns: Sequence[Turn]) -> float:
    """Nats by which one level surface, of any restitution, explains turns near a height better than hits.

    Hits return a ball on average: the logarithms of their restitutions are normal about zero, with a spread that they
    share, as do their heights.
    """
    restitutions = np.array([turn.restitution for turn in turns])
    heights = np.array([turn.height for turn in turns if turn.bounce])
    hits = _normal(np.log(restitutions), _STRENGTHS) / restitutions
    level = np.array([turn.bounce for turn in turns])
    bounces = level * _normal(restitutions - _RESTITUTION[:, None], _SPREAD)
    mixed = (1.0 - _ODD) * bounces[:, None] + _ODD * hits
    off = heights - (heights.mean() + np.linspace(-_SAME, _SAME, 81))[:, None]
    even, uneven = (_log_mean(np.log(_normal(off[:, None], spread)).sum(axis=2)) for spread in (_LEVEL, _UNEVEN))
    return _log_mean(np.log(mixed).sum(axis=2)) - _log_mean(np.log(hits).sum(axis=1)) + even - uneven


def _normal(off: Array, spread: Array | float) -> Array:
    """Density at distances from the mean of a normal distribution."""
    return np.asarray(np.exp(-0.5 * (off / spread) ** 2) / (np.sqrt(2.0 * np.pi) * spread))


def _log_mean(logs: Array) -> float:
    """Logarithm of the mean of the exponentials of an array."""
    return float(logs.max() + np.log(np.mean(np.exp(logs - logs.max()))))


def reverses(times: Array, positions: Array) -> bool:
    """True if the horizontal motion of a ball turns back, as at a wall or a racket; of (n,) s and (n, 3) m."""
    # medians of three in a row, so that an outlier turns nothing
    times, places = times[1:-1], np.median([positions[:-2, :2], positions[1:-1, :2], positions[2:, :2]], axis=0)
    ahead = np.searchsorted(times, times + _ARM)
    ahead = ahead[ahead < len(times)]
    way = (places[ahead] - places[: len(ahead)]) / _ARM
    before, after = way[: int((ahead < len(way)).sum())], way[ahead[ahead < len(way)]]
    fast = np.minimum(np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)) > _REVERSED
    return bool((fast & ((before * after).sum(axis=1) < 0.0)).any())


def _scatter(values: Array) -> float:
    """Standard deviation of values (n,), whatever a few of them are."""
    return MAD_TO_SIGMA * float(np.median(np.abs(values - np.median(values))))


def most_swerve_of(ball: Ball) -> float:
    """Largest change of the horizontal velocity over that of the vertical one, in a bounce: no more than friction."""
    model = nominal_model(ball)
    name = "bounce.friction.mu"
    friction = float(dict(model.named_parameters())[name].detach())
    return max(_MOST_SWERVE, friction + _ROUGH * model.declared_coefficients()[name].sigma)


def turns_of(times: Array, positions: Array, most_swerve: float = _MOST_SWERVE) -> list[Turn]:
    """The turns of a ball, where arcs before and after meet; of times (n,) s and positions (n, 3) m."""
    found: list[tuple[float, float, Turn]] = []
    heights = positions[:, 2]
    for i in range(1, len(times) - 2):
        # the bounce lies between samples i and i + 1, or one of them is the lowest of its neighbours
        if min(heights[i], heights[i + 1]) > min(heights[i - 1], heights[i + 2]):
            continue
        first = min(int(np.searchsorted(times, times[i] - _ARM)), max(i - _LEAST_SAMPLES + 1, 0))
        last = int(np.searchsorted(times, times[i + 1] + _ARM, side="right"))
        last = max(last, min(i + 1 + _LEAST_SAMPLES, len(times)))
        if i + 1 - first < _LEAST_SAMPLES or last - i - 1 < _LEAST_SAMPLES:
            continue
        arms = (slice(first, i + 1), slice(i + 1, last))  # the flight before, up to i, and after
        before, after = (_arc(times[part], heights[part], times[i]) for part in arms)
        if before[1] > -_LEAST_SPEED or after[1] < _LEAST_SPEED or max(before[2], after[2]) > _MOST_RESIDUAL:
            continue
        when = (before[0] - after[0]) / (after[1] - before[1])
        step = times[i + 1] - times[i]
        if -0.1 * step <= when <= 1.1 * step:
            height = before[0] + before[1] * when - 0.5 * _GRAVITY * when**2
            fall = max(_GRAVITY * when - before[1], _LEAST_SPEED)
            along = [np.polyfit(times[part] - times[i], positions[part, :2], 1)[0] for part in arms]
            change = (along[1] - along[0]) / (after[1] - before[1])
            gain = float(change @ along[0]) / max(float(np.linalg.norm(along[0])), 1e-9)
            turn = Turn(height, (after[1] - _GRAVITY * when) / fall, float(np.linalg.norm(change)), gain, most_swerve)
            found.append((before[2] + after[2], times[i] + when, turn))
    kept: list[tuple[float, float, Turn]] = []
    for one in sorted(found, key=lambda one: one[:2]):  # the best-fitting of turns less than an arm apart
        if all(abs(one[1] - other[1]) > _ARM for other in kept):
            kept.append(one)
    return [turn for _, _, turn in kept]


def _arc(times: Array, heights: Array, origin: float) -> tuple[float, float, float]:
    """Height and vertical speed at the origin of a free fall through the samples, and its residual (m)."""
    s = times - origin
    lifted = heights + 0.5 * _GRAVITY * s**2
    design = np.stack([np.ones_like(s), s], axis=1)
    (height, speed), *_ = np.linalg.lstsq(design, lifted, rcond=None)
    residual = lifted - design @ (height, speed)
    return float(height), float(speed), float(np.sqrt(np.mean(residual**2)))


def ball_of(choices: Choices, frame: Frame) -> tuple[Ball, Guess, list[str]]:
    """The ball, by its drag, the confidence in it, and a doubt where it falls as another one.

    Raises: FileNotFoundError, ValueError: an unknown ball.
    """
    if choices.ball is not None:
        from ballfg.simulation.balls import ball_kind

        ball = BALLS[choices.ball] if choices.ball in BALLS else ball_kind(choices.ball).ball
        return ball, Guess("ball", choices.ball, "as given", "stated", f"--ball {choices.ball}"), []
    why, sure, doubts = "too little flight to show the drag", "unsure", []
    if frame.drag is not None and frame.windows >= _SURE_WINDOWS:
        why = f"the drag is only {frame.drag:.2f} 1/m (a tennis ball has 0.02): if it is another ball, name it"
        if frame.drag >= _TENNIS_DRAG:
            why, sure = f"drag {frame.drag:.2f} 1/m; a table-tennis ball has 0.13, a tennis ball 0.02", "likely"
        elif frame.other_ball >= SURE:
            doubts = [f"the ball flies with a drag of {frame.drag:.2f} 1/m, a table-tennis ball with 0.13: name it"]
    return TABLE_TENNIS, Guess("ball", "table-tennis", why, sure, "--ball tennis"), doubts


def table_of(
    tracks: Sequence[Track], flights: Sequence[Track], ball: Ball, choices: Choices
) -> tuple[float | None, Guess, list[str]]:
    """The height of the table's surface in m, None without one, the confidence in it, and a doubt for `dataset.yaml`.

    Args: tracks: all.  flights: those in them; bounces of a ball in a hand are none.
    """
    if choices.table_height is not None:
        height = choices.table_height
        return height, Guess("table height", f"{height:g} m", "as given", "stated", f"--table-height {height:g}"), []
    handled = len(flights) != len(tracks) or any(a is not b for a, b in zip(flights, tracks, strict=True))
    found = surface(((track.seconds, track.positions) for track in flights), handled, most_swerve_of(ball))
    if found is None:
        return None, *_without(flights, ball)
    height = round(found.centre - ball.radius, 4)
    others = "".join(f"; also at {other - ball.radius:.2f} m" for other in found.others)
    one = "1 bounce" if found.bounces == 1 else f"{found.bounces} bounces"
    why = f"{one}, scatter {1e3 * found.spread:.1f} mm{others}"
    sure = "sure" if found.bounces >= 3 and not found.others else "likely"
    return height, Guess("table height", f"{height:g} m", why, sure, f"--table-height {height:g}"), []


def _without(flights: Sequence[Track], ball: Ball) -> tuple[Guess, list[str]]:
    """The guess that there is no surface, and a doubt if some turns of the balls may be bounces."""
    most = most_swerve_of(ball)
    turns = [turn for flight in flights for turn in turns_of(flight.seconds, flight.positions, most)]
    heights = [turn.height - ball.radius for turn in turns if turn.bounce]
    if not heights:
        return Guess("table height", NO_SURFACE, "no ball bounces", "likely", "--table-height 0.76"), []
    typed = f"--table-height {np.median(heights):.2f}"
    where = f"at {min(heights):.2f} to {max(heights):.2f} m" if len(heights) > 1 else f"at {heights[0]:.2f} m"
    many = "one turn" if len(heights) == 1 else f"{len(heights)} turns"
    why = f"{many} {where} may be bounces or hits"
    return Guess("table height", NO_SURFACE, why, "unsure", typed), [f"no surface is known: {why}"]
