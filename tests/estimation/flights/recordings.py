"""Recordings with their truth: balls that are held, carried, dribbled, juggled, thrown and caught, that roll and rest.

Hands move on polynomials of fifth degree (minimum jerk between given ends); a ball flies with drag and lift, integrated
here, and bounces on the floor. Nothing of ballfg makes the motion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.signal import butter, lfilter

from ballfg.arrays import Array
from ballfg.tracks import Track

FLIGHT, HELD, ROLLING, RESTING = "flight", "held", "rolling", "resting"
BALLS = {"table tennis": (0.02, 0.13, 0.85), "basketball": (0.12, 0.011, 0.75), "juggling": (0.035, 0.012, 0.3)}
"""Radius m, drag 1/m, restitution."""
RATES = (30, 50, 60, 100, 120, 200, 240, 300)
STEP = 5e-4
"""s, of the integration."""
GRAVITY = 9.81
SLOW = 0.2
"""m/s. A bounce that leaves less ends the flight: the ball rolls out."""


@dataclass
class Take:
    """A motion while it is made: dense positions (k, 3) m at `STEP`, a label each, and its random numbers."""

    rng: np.random.Generator
    radius: float
    drag: float
    restitution: float
    places: list[Array] = field(default_factory=list)
    labels: list[str] = field(default_factory=list)
    position: Array = field(default_factory=lambda: np.zeros(3))
    velocity: Array = field(default_factory=lambda: np.zeros(3))

    def add(self, positions: Array, label: str, velocity: Array) -> None:
        """Appends positions (k, 3) m; velocity (3,) m/s at their end."""
        self.places.append(positions)
        self.labels += [label] * len(positions)
        if len(positions):
            self.position = positions[-1]
        self.velocity = velocity

    def hand(self, place: Array, velocity: Array, seconds: float, pull: Array, start: Array, label: str = HELD) -> None:
        """A hand moves the ball to a place with a velocity; pull and start: (3,) m/s^2 at the end and the start."""
        end = np.stack((place, velocity, pull))
        t = seconds
        known = np.array([[1, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0], [0, 0, 2, 0, 0, 0],
                          [1, t, t**2, t**3, t**4, t**5], [0, 1, 2 * t, 3 * t**2, 4 * t**3, 5 * t**4],
                          [0, 0, 2, 6 * t, 12 * t**2, 20 * t**3]], dtype=float)  # fmt: skip
        weights = np.linalg.solve(known, np.concatenate((np.stack((self.position, self.velocity, start)), end)))
        s = STEP * np.arange(1, max(int(seconds / STEP), 1) + 1)
        self.add(s[:, None] ** np.arange(6) @ weights, label, velocity)

    def still(self, seconds: float, label: str, tremor: float = 0.0) -> None:
        """The ball stays where it is; tremor: m, of a hand."""
        s = STEP * np.arange(1, int(seconds / STEP) + 1)
        phases, speeds = self.rng.uniform(0, 2 * np.pi, (2, 3)), self.rng.uniform(3, 12, (2, 3))
        wave = sum(np.sin(s[:, None] * w + f) - np.sin(f) for w, f in zip(speeds, phases, strict=True))
        self.add(self.position + tremor * np.asarray(wave), label, np.zeros(3))

    def fly(self, until: Callable[[Array, Array, float], bool], floor: bool = True) -> None:
        """Flies, and bounces on the floor, until a function of position, velocity and seconds says so."""
        p, v, t = self.position.copy(), self.velocity.copy(), 0.0
        spin, found = self.rng.normal(0.0, 20.0, 3), list[Array]()
        lift = 0.0015 if self.drag > 0.05 else 0.0003

        def pull(u: Array) -> Array:
            return -self.drag * np.linalg.norm(u) * u + lift * np.cross(spin, u) - np.array([0.0, 0.0, GRAVITY])

        while t < 8.0 and not until(p, v, t):
            half = v + 0.5 * STEP * pull(v)
            p, v, t = p + STEP * half, v + STEP * pull(half), t + STEP
            if floor and p[2] < self.radius and v[2] < 0.0:
                p[2], v = 2 * self.radius - p[2], v * np.array([0.9, 0.9, -self.restitution])
                if v[2] < SLOW:  # it stays down
                    self.add(np.array(found).reshape(-1, 3), FLIGHT, v)
                    self.roll(2.0, 0.8)
                    self.still(0.5, RESTING)
                    return
            found.append(p)
        self.add(np.array(found).reshape(-1, 3), FLIGHT, v)

    def roll(self, seconds: float, slowing: float) -> None:
        """Rolls with a deceleration m/s^2 at its height; stops at most."""
        speed = float(np.hypot(*self.velocity[:2]))
        way = self.velocity * np.array([1.0, 1.0, 0.0]) / max(speed, 1e-9)
        s = STEP * np.arange(1, int(min(seconds, speed / slowing) / STEP) + 1)
        self.add(self.position + (speed * s - 0.5 * slowing * s**2)[:, None] * way, ROLLING,
                 way * max(speed - slowing * (s[-1] if len(s) else 0.0), 0.0))  # fmt: skip

    def throw(self, speed: float, angle: float, heading: float) -> None:
        """A hand throws: it moves the ball by some decimetres within 0.15 - 0.4 s, and lets go."""
        way = np.array([np.cos(angle) * np.cos(heading), np.cos(angle) * np.sin(heading), np.sin(angle)])
        seconds = float(self.rng.uniform(1.2, 2.2)) * 0.45 / speed + 0.08
        pull = way * self.rng.uniform(0.0, 40.0)
        self.hand(self.position + 0.4 * speed * seconds * way, speed * way, seconds, pull, np.zeros(3))

    def catch(self) -> None:
        """A hand stops the ball over 0.08 - 0.3 m: it begins to slow down at once."""
        speed, give = float(np.linalg.norm(self.velocity)), float(self.rng.uniform(0.08, 0.3))
        way = self.velocity / max(speed, 1e-9)
        start = -way * speed**2 / (2.0 * give) * self.rng.uniform(0.8, 1.5)
        self.hand(self.position + give * way, np.zeros(3), 2.2 * give / max(speed, 0.5), np.zeros(3), start)


def _thrown(take: Take) -> None:
    rng = take.rng
    take.position = np.array([0.0, 0.0, rng.uniform(1.0, 2.0)])
    take.still(rng.uniform(0.2, 1.5), HELD, 0.002)
    take.throw(rng.uniform(3.0, 8.0), rng.uniform(0.2, 1.2), rng.uniform(0, 6.28))
    end = rng.choice(("caught", "bounces", "flies"))
    if end == "caught":
        take.fly(lambda p, v, t: v[2] < 0 and p[2] < 1.2)
        take.catch()
        take.still(rng.uniform(0.2, 1.0), HELD, 0.002)
    else:
        seconds = rng.uniform(0.5, 1.0) if end == "flies" else rng.uniform(1.0, 2.5)
        take.fly(lambda p, v, t: t > seconds)


def _dribbled(take: Take) -> None:
    rng = take.rng
    take.position = np.array([0.0, 0.0, rng.uniform(0.8, 1.1)])
    take.still(rng.uniform(0.2, 1.0), HELD, 0.002)
    top = take.position[2]
    for _ in range(int(rng.integers(3, 10))):
        speed, seconds = rng.uniform(2.0, 4.0), rng.uniform(0.1, 0.25)
        place = np.array([*take.position[:2], top - 0.3 * speed * seconds])
        take.hand(place, np.array([*rng.normal(0.0, 0.15, 2), -speed]), seconds,
                  np.array([0.0, 0.0, -rng.uniform(10.0, 40.0)]), np.array([0.0, 0.0, -rng.uniform(20.0, 40.0)])
                  if take.velocity[2] > 0.5 else np.zeros(3))  # fmt: skip
        take.fly(lambda p, v, t: t > 0.2 and (v[2] < 0.3 or p[2] > top - 0.1) and v[2] > -1.0)
    take.catch()
    take.still(0.3, HELD, 0.002)
    take.throw(rng.uniform(5.0, 8.0), rng.uniform(0.7, 1.1), 0.0)
    take.fly(lambda p, v, t: t > 1.0)


def _juggled(take: Take) -> None:
    rng = take.rng
    take.position, side = np.array([-0.25, 0.4, 1.0]), 1.0
    for _ in range(int(rng.integers(6, 16))):
        speed, seconds = rng.uniform(3.0, 4.5), rng.uniform(0.2, 0.45)
        flight = 2.0 * speed / GRAVITY
        velocity = np.array([side * 0.5 / flight, rng.normal(0.0, 0.1), speed])
        place = np.array([-side * 0.2, 0.4, 1.05]) + rng.normal(0.0, 0.03, 3)
        slow = -take.velocity * rng.uniform(10.0, 20.0)
        take.hand(place, velocity, seconds, np.array([0, 0, rng.uniform(0.0, 30.0)]), slow)
        take.fly(lambda p, v, t: v[2] < 0 and p[2] < 1.0)
        side = -side
    take.catch()
    take.still(0.4, HELD, 0.002)


def _carried(take: Take) -> None:
    rng = take.rng
    take.position = np.array([0.0, 0.0, rng.uniform(0.9, 1.3)])
    for _ in range(int(rng.integers(2, 6))):
        to = take.position + np.array([*rng.normal(0.0, 0.7, 2), rng.normal(0.0, 0.15)])
        to[2] = max(to[2], 0.6)
        take.hand(to, np.zeros(3), rng.uniform(0.5, 1.5), np.zeros(3), np.zeros(3))
        if rng.random() < 0.5:
            take.still(rng.uniform(0.1, 0.6), HELD, 0.003)
    if rng.random() < 0.7:  # it drops
        take.fly(lambda p, v, t: t > 1.3)


def _rolled(take: Take) -> None:
    rng, height = take.rng, 0.76 + take.radius
    take.position, take.velocity = np.array([0.0, 0.0, height]), np.array([rng.uniform(0.6, 2.0), 0.3, 0.0])
    take.roll(rng.uniform(0.8, 1.5), rng.uniform(0.1, 0.3))
    if rng.random() < 0.6:
        take.fly(lambda p, v, t: t > 1.0)
    else:
        take.roll(9.0, 0.5)
        take.still(rng.uniform(0.3, 1.0), RESTING)
        if rng.random() < 0.6:
            take.hand(take.position + np.array([0.1, 0.2, 0.5]), np.zeros(3), 0.7, np.zeros(3), np.zeros(3))
            take.throw(rng.uniform(3.0, 6.0), rng.uniform(0.2, 1.0), rng.uniform(0, 6.28))
            take.fly(lambda p, v, t: t > 0.7)


def _caught(take: Take) -> None:
    rng = take.rng
    take.position, heading = np.array([0.0, 0.0, 1.4]), 0.0
    for _ in range(int(rng.integers(2, 5))):
        take.still(rng.uniform(0.1, 0.8), HELD, 0.002)
        take.throw(rng.uniform(4.0, 7.0), rng.uniform(0.3, 0.9), heading)
        take.fly(lambda p, v, t: t > 0.25 and v[2] < 0 and p[2] < 1.5)
        take.catch()
        heading += np.pi
    take.still(0.3, HELD, 0.002)


def _held(take: Take) -> None:
    take.position = np.array([0.0, 0.0, 1.2])
    for _ in range(4):
        take.still(take.rng.uniform(0.1, 0.8), HELD, 0.003)
        to = take.position + take.rng.normal(0.0, 0.2, 3)
        take.hand(to, np.zeros(3), take.rng.uniform(0.25, 0.6), np.zeros(3), np.zeros(3))


KINDS = {"thrown": _thrown, "dribbled": _dribbled, "juggled": _juggled, "carried": _carried, "rolled": _rolled,
         "caught": _caught, "held": _held}  # fmt: skip


def _tapped(take: Take) -> None:
    """A foot or a racket taps the ball up again and again, within a sample, at about one height."""
    rng = take.rng
    take.position, take.velocity = np.array([0.0, 0.0, 0.9]), np.array([0.0, 0.0, 3.0])
    spread = rng.uniform(0.0, 0.15)
    for _ in range(int(rng.integers(5, 15))):
        low = 0.9 + rng.normal(0.0, spread)
        take.fly(lambda p, v, t, low=low: v[2] < 0 and p[2] < low, floor=False)
        take.velocity = np.array([*rng.normal(0.0, 0.2, 2), rng.uniform(2.0, 4.5)])


def _walled(take: Take) -> None:
    """A ball flies to a wall and back, with a racket's stroke between."""
    take.position = np.array([0.0, 0.0, 1.2])
    for _ in range(int(take.rng.integers(2, 6))):
        take.velocity = np.array([take.rng.uniform(5.0, 9.0), 0.3, take.rng.uniform(1.0, 3.0)])
        take.fly(lambda p, v, t: p[0] > 3.0, floor=False)
        take.velocity = take.velocity * np.array([-0.8, 0.9, 0.9])
        take.fly(lambda p, v, t: p[0] < 0.2 or p[2] < 0.6, floor=False)


WITHOUT_TABLE = {"juggled": _juggled, "caught": _caught, "held": _held, "tapped": _tapped, "walled": _walled}
"""Motions in which nothing is a table or a floor."""


@dataclass(frozen=True)
class Recording:
    """A measured track with the true label of each sample, and what it is."""

    track: Track
    labels: list[str]
    kind: str
    rate: float
    noise: float
    """m."""
    truth: Array
    """(n, 3) m, true positions."""


def recording(seed: int, low_pass: float | None = None, kind: str | None = None) -> Recording:
    """One recording. Args: seed: of all that is random.  low_pass: Hz, of a tracker that smooths.  kind: of `KINDS`."""
    rng = np.random.default_rng((39, seed))
    kind = list(KINDS)[seed % len(KINDS)] if kind is None else kind
    ball = "basketball" if kind == "dribbled" else "juggling" if kind == "juggled" else rng.choice(list(BALLS))
    take = Take(rng, *BALLS[ball])
    {**KINDS, **WITHOUT_TABLE}[kind](take)
    rate, noise = float(rng.choice(RATES)), float(np.exp(rng.uniform(*np.log((1e-3, 1e-2)))))
    dense = np.concatenate(take.places)
    times = np.arange(rng.uniform(0.0, 1.0 / rate), STEP * (len(dense) - 1), 1.0 / rate)
    at = np.clip(np.round(times / STEP).astype(int), 0, len(dense) - 1)
    measured = dense[at] + rng.normal(0.0, noise, (len(at), 3))
    if low_pass is not None:
        b, a = butter(2, low_pass / (rate / 2.0))
        measured = lfilter(b, a, measured - measured[0], axis=0) + measured[0]
    return Recording(
        Track(times, measured, name=f"{kind}{seed}"), [take.labels[i] for i in at], kind, rate, noise, dense[at]
    )
