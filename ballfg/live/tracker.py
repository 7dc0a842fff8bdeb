"""Tracks any number of balls: positions come in, states go out, one stamp at a time."""

from __future__ import annotations

from bisect import insort
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ballfg.arrays import Array
from ballfg.checks import as_float, check_array, check_count, check_range
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.online.online import Online
from ballfg.estimation.online.scatter import StreamScatter
from ballfg.estimation.online.state import OnlineState
from ballfg.estimation.settings import Settings
from ballfg.live.ball import MISSED, PATIENCE, Ball, BallEvent, Kept, Newcomer
from ballfg.live.clock import Clock, Stamp
from ballfg.live.gate import FAR, GATE, HIT_GATE, Gate, assign
from ballfg.tracks import Ball as BallKind
from ballfg.tracks.stamps import StreamOrigin

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel

GAP = 0.5  # s. A ball unseen for longer is lost; the estimator links nothing over longer gaps either.
CONFIRM = 3  # Number of consistent samples that make a ball: the least that allow a check of the velocity
MOST_BALLS = 16  # Largest number of balls at once
MOST_NEWCOMERS = 32
"""Largest number of possible balls. The oldest are dropped first, so that clutter costs a bounded time."""
FARTHEST = 1000.0  # m, of a coordinate. A larger one is in another unit.
LATEST = 1e11  # s, of a stamp: 3,000 years. A larger one is in another unit.


@dataclass(frozen=True, eq=False)
class BallUpdate:
    """The result for one position, or for one ball.

    Attributes:
        kind: `state`: a ball took the position in. `newcomer`: it may become a ball. `lost`: a ball was unseen for so
            long that it is dropped. `refused`: the position was not used.
        time: s, the position's stamp; of a lost ball its last.
        ball: number of the ball, from 1; None without one.
        position: (3,) m as measured; None of a lost ball.
        state: the ball's newest state; None without one.
        samples: number of the ball's samples.
        events: newly found bounces, hits, rests and gaps, some of them some samples ago.
        late: True if the sample was inserted before others: the state is that of a later stamp.
        reason: reason for a refused position, or an error of a state; else empty.
    """

    kind: str
    time: float
    ball: int | None = None
    position: Array | None = None
    state: OnlineState | None = None
    samples: int = 0
    events: tuple[BallEvent, ...] = ()
    late: bool = False
    reason: str = ""


@dataclass
class Counts:
    """Counts of a tracker's input.

    Attributes:
        positions: received.  balls: begun.  lost: of these.
        late: positions inserted before others.  old: positions older than the lag, dropped.
        repeated: positions at a stamp that the ball had already, dropped.
        malformed: positions that are not finite or not in m, dropped.
        stray: stamps that the next one disproved.  restarts: of the sender's clock.
        failed: samples that the estimator could not explain.
    """

    positions: int = 0
    balls: int = 0
    lost: int = 0
    late: int = 0
    old: int = 0
    repeated: int = 0
    malformed: int = 0
    stray: int = 0
    restarts: int = 0
    failed: int = 0


@dataclass
class _Frame:
    """The positions of one stamp, and the result of each; its time is counted from the stream's first stamp."""

    time: float
    late: bool
    positions: Array
    sigmas: Sequence[Array | None]
    updates: list[BallUpdate | None] = field(default_factory=list)

    @property
    def open(self) -> list[int]:
        """The positions without a result."""
        return [k for k, update in enumerate(self.updates) if update is None]

    def kept(self, k: int, by_hit: bool = False) -> Kept:
        """A position as a sample of a ball."""
        return Kept(self.time, self.positions[k], self.sigmas[k], by_hit)

    def refuse(self, k: int, reason: str) -> None:
        self.updates[k] = BallUpdate("refused", self.time, position=self.positions[k], reason=reason)


class Tracker:
    """Follows balls: begins them, distinguishes them, estimates each by `Online`, and drops the lost ones.

    A position belongs to the ball whose predicted place fits best. A position without a fitting ball begins a newcomer,
    which becomes a ball with its third consistent sample. Positions may come late by up to the lag: they are inserted
    in their place, and the states are those of the positions in order. Work and memory do not grow with the stream.

    Args:
        model: the ball; of a `Ball`, its nominal model.
        surfaces: table and floor; for a number (m), a table of that height with the floor below it.
        settings: noise and priors; None: those of measured tracks.
        lag: s, largest delay of a position.
        gap: s, after which an unseen ball is dropped.
        confirm: number of consistent samples that make a ball.
        most: largest number of balls at once; positions of further ones are refused.
        shown_noise: True: positions without sigmas have the noise that their balls show, not the settings'; a ball
            begins with that of earlier ones. None: if neither settings nor the model's file state it.

    Attributes:
        counts: of the input and its results.

    Raises: ValueError: a number out of range, or as `Online`. TypeError: not a number.
    """

    def __init__(
        self,
        model: BallModel | BallKind,
        surfaces: Surfaces | float = 0.0,
        settings: Settings | None = None,
        *,
        lag: float = 0.1,
        gap: float = GAP,
        confirm: int = CONFIRM,
        most: int = MOST_BALLS,
        shown_noise: bool | None = None,
    ) -> None:
        self.lag = check_range("lag", lag, 0.0, 10.0)
        self.gap = check_range("gap", gap, 1e-3, 60.0)
        self.confirm = check_count("confirm", confirm, 1, 20)
        self.most = check_count("most", most, 1, 1000)
        usual = Online(model, surfaces, settings, shown_noise=shown_noise)
        own = replace(usual.settings, solver=usual.settings.solver or "ballfg")  # in the time that several balls leave
        self.estimator = Online(usual.model, usual.surfaces, own, shown_noise=usual.shown_noise)
        noise = own.position_scale * np.hypot(own.position_noise, own.memory)
        self.gate = Gate(self.estimator.physics, self.estimator.surfaces.heights(), noise, own.stamp_jitter)
        self.counts = Counts()
        self._begin()

    def _begin(self) -> None:
        self._clock = Clock(self.lag, self.gap)
        self._balls: list[Ball] = []
        self._newcomers: list[Newcomer] = []
        self._origin = StreamOrigin()

    @property
    def balls(self) -> dict[int, OnlineState]:
        """The newest state of every ball by its number."""
        return {ball.number: self._dated_state(ball.states[-1]) for ball in self._balls}

    def push(self, time: float, positions: ArrayLike, sigmas: ArrayLike | None = None) -> list[BallUpdate]:
        """Takes in the positions of one stamp.

        Positions of one stamp belong to different balls. They may come in one call or in several.

        Args:
            time: s, on the sender's clock.  positions: (3,) or (n, 3) m.
            sigmas: (3,) or (n, 3) m, their standard deviations; None: the settings'.
        Returns: balls that were lost until then, and one update per position, in their order. An unusable position is
            refused: a sender's errors raise nothing.
        Raises: ValueError: positions or sigmas of another shape. TypeError: a time that is no number.
        """
        points = np.atleast_2d(check_array("positions", positions, remedy="Give x, y and z in m.", most=np.inf))
        if points.shape[-1] != 3 or points.ndim != 2:
            raise ValueError(f"positions must be (3,) or (n, 3) m; got {np.shape(positions)}. Give x, y and z.")
        spreads: Sequence[Array | None] = [None] * len(points)
        if sigmas is not None:
            given = check_array("sigmas", sigmas, remedy="Give one number in m per axis.", most=np.inf)
            if given.shape not in ((3,), points.shape):
                raise ValueError(f"sigmas must be (3,) or as positions, {points.shape}; got {given.shape}.")
            spreads = list(np.broadcast_to(given, points.shape))
        stamp = as_float("time", time, "s")
        since = self._origin.elapsed(stamp) if abs(stamp) <= LATEST else stamp * np.inf
        frame = _Frame(since, False, points, spreads, [None] * len(points))
        self.counts.positions += len(points)
        self._refuse_unusable(frame, stamp)
        gone = self._turn_clock(frame) if frame.open else []
        if frame.open:
            self._to_balls(frame, GATE, hit=False)
            self._to_newcomers(frame)
            self._refuse_repeated(frame)  # of a newcomer that has just become a ball
            self._to_balls(frame, HIT_GATE, hit=True)
            for k in frame.open:
                if self._repeats_newcomer(frame, k):
                    continue
                self._newcomers.append(Newcomer(frame.kept(k), self.gate))
                frame.updates[k] = self._grown(self._newcomers[-1], frame, k)
            del self._newcomers[:-MOST_NEWCOMERS]
        return [self._dated(update) for update in (*gone, *frame.updates) if update is not None]

    def _dated_state(self, state: OnlineState) -> OnlineState:
        return replace(state, time=self._origin.written(state.time))

    def _dated(self, update: BallUpdate) -> BallUpdate:
        return replace(
            update,
            time=self._origin.written(update.time),
            state=None if update.state is None else self._dated_state(update.state),
            events=tuple(replace(event, time=self._origin.written(event.time)) for event in update.events),
        )

    def tidy(self) -> None:
        """Does the deferrable work: call it after the updates were used, for a quicker next push."""
        for ball in self._balls:
            ball.tidy()

    def end(self) -> list[BallUpdate]:
        """Drops all balls at the end of a stream: later samples are unrelated to them.

        Returns: one update for each ball.
        """
        gone = [self._dated(self._lost(ball)) for ball in self._balls]
        self._begin()
        return gone

    def _refuse_unusable(self, frame: _Frame, stamp: float) -> None:
        good = [bool((np.abs(position) <= FARTHEST).all()) for position in frame.positions]  # NaN is not
        for k, (point, sigma) in enumerate(zip(frame.positions, frame.sigmas, strict=True)):
            if not np.isfinite(frame.time):
                reason = f"the stamp is beyond {LATEST:g} s" if np.isfinite(stamp) else "the stamp is not finite"
            elif not good[k]:
                far = np.isfinite(point).all()
                reason = f"a coordinate is beyond {FARTHEST:g} m" if far else "a coordinate is not finite"
            elif sigma is not None and not (np.isfinite(sigma) & (sigma > 0.0)).all():
                reason = "a standard deviation is not positive and finite"
            else:
                continue
            self.counts.malformed += 1
            frame.refuse(k, reason)

    def _turn_clock(self, frame: _Frame) -> list[BallUpdate]:
        stamp = self._clock.tell(frame.time)
        gone: list[BallUpdate] = []
        if stamp is Stamp.OLD:
            self.counts.old += len(frame.open)
            reason = f"older than the newest stamp by more than the lag of {self.lag:g} s"
            for k in frame.open:
                frame.refuse(k, reason)
        elif stamp is Stamp.RESTART:
            self.counts.restarts += 1
            gone = [self._lost(ball) for ball in self._balls]
            self._balls, self._newcomers = [], []
        elif stamp is Stamp.BACK:
            self.counts.stray += 1
            gone = self._undo_after(self._clock.newest)
        frame.late = stamp is Stamp.LATE
        self.counts.late += len(frame.open) if frame.late else 0
        now = self._clock.safe
        unseen = [ball for ball in self._balls if ball.last < now - self.gap]
        self._balls = [ball for ball in self._balls if ball not in unseen] if unseen else self._balls
        forgotten = now - self._patience
        self._newcomers = [newcomer for newcomer in self._newcomers if newcomer.last >= forgotten]
        return [*gone, *map(self._lost, unseen)]

    @property
    def _patience(self) -> float:
        """s, for which a newcomer may be unseen. Each ball may have stamps of its own."""
        followed = 1 + len(self._balls) + len(self._newcomers)
        return min(PATIENCE, MISSED * followed * self._clock.usual_step)

    def _undo_after(self, time: float) -> list[BallUpdate]:
        """Reverts the effect of a wrong stamp; a ball without other samples is lost."""
        self._newcomers = [newcomer for newcomer in self._newcomers if newcomer.last <= time]
        gone = []
        for ball in list(self._balls):
            farewell, left = self._lost(ball), False
            try:
                left = ball.forget_after(time)
            except (ValueError, RuntimeError):
                self.counts.failed += 1
            if left:
                self.counts.lost -= 1
            else:
                self._balls.remove(ball)
                gone.append(farewell)
        return gone

    def _lost(self, ball: Ball) -> BallUpdate:
        self.counts.lost += 1
        return BallUpdate("lost", ball.last, ball.number, state=ball.states[-1], samples=ball.samples)

    def _to_balls(self, frame: _Frame, gate: float, hit: bool) -> None:
        """Assigns open positions to the balls that they fit: on their path, or after a hit."""
        if not hit:
            self._refuse_same(frame)
        rows, t = frame.open, frame.time
        if not rows:
            return
        balls = [ball for ball in self._balls if ball.accepts(t) and abs(t - ball.last) <= self.gap]
        costs = np.full((len(rows), len(balls)), FAR)
        for j, ball in enumerate(balls):
            held = ball.at(t)
            if held is not None and (hit or not held.by_hit):
                continue
            known = ball.known(t)
            costs[:, j] = (self.gate.if_hit if hit else self.gate.on_path)(known, t, frame.positions[rows])
        for i, j in assign(costs, gate):
            k = rows[i]
            frame.updates[k] = self._taken(balls[j], frame, k, frame.kept(k, hit))
        if not hit:
            self._refuse_repeated(frame)

    def _refuse_same(self, frame: _Frame) -> None:
        """Refuses exact copies of a ball's positions, which another ball might fit."""
        held = [(ball.number, kept.position) for ball in self._balls if (kept := ball.at(frame.time)) is not None]
        for k in frame.open if held else ():
            for number, position in held:
                if np.array_equal(position, frame.positions[k]):
                    self._refuse_copy(frame, k, f"ball {number} has a position of this stamp")
                    break

    def _refuse_copy(self, frame: _Frame, k: int, reason: str) -> None:
        self.counts.repeated += 1
        frame.refuse(k, reason)

    def _refuse_repeated(self, frame: _Frame) -> None:
        """Refuses a position beside one of the same ball and stamp: the ball was measured twice."""
        for k in frame.open:
            for ball in self._balls:
                held = ball.at(frame.time)
                if held is None:
                    continue
                near = self.gate.on_path(ball.known(frame.time), frame.time, frame.positions[[k]])[0] <= GATE
                apart = float(np.linalg.norm(held.position - frame.positions[k]))
                if near and apart < 2 * self.estimator.model.radius:  # two balls cannot be closer
                    self._refuse_copy(frame, k, f"ball {ball.number} has a position of this stamp")
                    break

    def _taken(self, ball: Ball, frame: _Frame, k: int, kept: Kept) -> BallUpdate:
        reason, displaced = "", ball.at(kept.time)
        told = ball.scatter is None or ball.scatter.known
        try:
            state = ball.take(kept)
        except (ValueError, RuntimeError) as error:
            self.counts.failed += 1
            reason = f"the estimator began anew: {' '.join(str(error).split())}"
            try:
                state = ball.start_anew(kept)
            except (ValueError, RuntimeError):
                self._balls.remove(ball)
                return BallUpdate("refused", frame.time, ball.number, kept.position, reason=reason)
        if displaced is not None:
            self._newcomers.append(Newcomer(displaced, self.gate))
        if self.estimator.shown_noise and ball.scatter is not None:
            self._learn(ball.scatter, told)
        return BallUpdate(
            "state", frame.time, ball.number, kept.position, state, ball.samples, ball.news(), frame.late, reason
        )

    def _learn(self, scatter: StreamScatter, told: bool) -> None:
        """Sets the gate to the noise that the balls show; later balls begin with one that is known, told only once."""
        if scatter.known and not told:
            usual = self.estimator
            x, y, z = (scatter.found / usual.settings.position_scale).tolist()
            own = replace(usual.settings, position_noise=(x, y, z))
            self.estimator = Online(usual.model, usual.surfaces, own, shown_noise=True)
            self.estimator.scatter = StreamScatter(scatter.found, trusted=True)
        assert self.estimator.scatter is not None
        followed = [ball.scatter.sigma for ball in self._balls if ball.scatter is not None]
        self.gate.set_noise([self.estimator.scatter.sigma, *followed])

    def _to_newcomers(self, frame: _Frame) -> None:
        rows, t = frame.open, frame.time
        if not rows:
            return
        newcomers = [newcomer for newcomer in self._newcomers if not newcomer.has(t)]
        costs = np.full((len(rows), len(newcomers)), FAR)
        for j, newcomer in enumerate(newcomers):
            costs[:, j] = newcomer.distances(t, frame.positions[rows])
        for i, j in assign(costs, GATE):
            k, newcomer = rows[i], newcomers[j]
            insort(newcomer.samples, frame.kept(k))
            frame.updates[k] = self._grown(newcomer, frame, k)
        for k in frame.open:
            self._repeats_newcomer(frame, k)

    def _repeats_newcomer(self, frame: _Frame, k: int) -> bool:
        """Refuses a position where a newcomer is at the same stamp: two balls cannot be as close."""
        closest = 2 * self.estimator.model.radius
        repeated = any(newcomer.repeats(frame.time, frame.positions[k], closest) for newcomer in self._newcomers)
        if repeated:
            self._refuse_copy(frame, k, "a newcomer has a position of this stamp")
        return repeated

    def _grown(self, newcomer: Newcomer, frame: _Frame, k: int) -> BallUpdate:
        """A newcomer's update with a sample, which may make it a ball."""
        position, count = frame.positions[k], len(newcomer.samples)
        if count < self.confirm:
            return BallUpdate("newcomer", frame.time, position=position, samples=count, late=frame.late)
        self._newcomers = [other for other in self._newcomers if other is not newcomer]
        if len(self._balls) >= self.most:
            reason = f"{self.most} balls are followed already"
            return BallUpdate("refused", frame.time, position=position, reason=reason)
        self.counts.balls += 1
        ball = Ball(self.counts.balls, self.estimator, self.lag)
        self._balls.append(ball)
        for kept in newcomer.samples:
            update = self._taken(ball, frame, k, kept)
            if update.kind == "refused":
                break
        return update
