"""Events that no surface explains: starts, hits, tracker shifts, a resting ball that leaves."""

import math

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.segmentation.bank import FLYING, Bank, concatenate
from ballfg.estimation.segmentation.events import Event, EventKind, Node
from ballfg.estimation.segmentation.evidence import update
from ballfg.estimation.segmentation.kernels import OUTLIER
from ballfg.estimation.segmentation.motion import lift, put_down
from ballfg.estimation.segmentation.scene import Scene

SHORTEST_STEP = 1e-3
"""s. An event is not made dearer than this by stamps that lie closer."""
SHIFTED_PREDICTIONS = 3
"""How many of the best predictions are tried with a shift; beside a bounce the right one may be the third."""


def fresh(position: Array, position_variance: Array | float, scene: Scene) -> Bank:
    """One flying hypothesis at a position (3,) with a variance (3,) m^2, of which nothing else is known."""
    mean, cov = np.zeros((1, 3, 3)), np.zeros((1, 3, 3, 3))
    mean[0, :, 0] = position
    cov[0, :, 0, 0] = position_variance
    cov[0, :, 1, 1] = scene.settings.velocity_spread**2
    cov[0, :, 2, 2] = scene.settings.slack**2
    return Bank(
        mean,
        cov,
        surface=np.array([FLYING]),
        score=np.zeros(1),
        age=np.zeros(1, dtype=np.int64),
        shift=np.zeros((1, 3)),
        tips=np.array([None], dtype=object),
    )


def starts(
    tip: Node | None, score: float, position: Array, sigma: Array, scene: Scene, sample: int, time: float
) -> Bank:
    """Hypotheses after a first sample: a flying ball, one that rests on a surface nearby, or the sample an outlier.

    All three expect the ball within the spread of outliers of the sample, so that their evidence compares.

    Args:
        tip: last event before, or None.
        score: nats, carried on.
        position: (3,) m.
        sigma: (3,) m, its noise.
        scene: ball, surfaces, settings.
        sample: index of the sample.
        time: s, its stamp.
    """
    settings = scene.settings
    flying = fresh(position, settings.outlier_spread**2, scene)
    flying.score[0] = score
    flying.tips[0] = tip
    banks = [flying, *_rested(flying, position, scene, sample - 1, time)]
    lost = flying.take([0])
    lost.score += scene.log_shares[OUTLIER] - 3.0 * math.log(settings.outlier_spread)
    lost.add_event(0, Event(EventKind.OUTLIER, sample, time))
    used, _ = update(concatenate(banks), position, sigma, scene, sample, time)
    return concatenate([used, lost])


def hits(best: Bank, position: Array, dt: float, scene: Scene, interval: int, time: float) -> list[Bank]:
    """The best explanation of the past, its velocity forgotten: in the air, and on a surface if it is near one.

    Over a short interval the ball reappears close to where it was; over a long one it may be anywhere.
    """
    settings = scene.settings
    short = dt < settings.short_gap
    reach = settings.hit_spread**2 + (settings.velocity_spread * min(dt, settings.short_gap)) ** 2
    bank = fresh(best.mean[0, :, 0] if short else position, reach, scene)
    price = _rarity(settings.hit_rate, dt) + settings.hit_cost * math.exp(-dt / settings.short_gap)
    bank.score = best.score - price
    bank.tips = best.tips.copy()
    bank.add_event(0, Event(EventKind.HIT, interval, time))
    return [bank, *_rested(bank, position, scene, interval, time)]


def shifts(
    predicted: Bank, position: Array, sigma: Array, dt: float, scene: Scene, interval: int, time: float
) -> list[Bank]:
    """The best predictions, with the measurements jumping by an unknown offset: off from now on, or until now.

    Which of the two shows at the next surface only.
    """
    settings = scene.settings
    if dt >= settings.short_gap:
        return []
    bank = predicted.take(np.argsort(-predicted.score, kind="stable")[:SHIFTED_PREDICTIONS])
    bank.cov[:, :, 0, 0] += settings.shift_spread**2
    bank.score = bank.score - _rarity(settings.shift_rate, dt) - settings.shift_cost
    bank.age = np.zeros(len(bank), dtype=np.int64)
    for row in range(len(bank)):
        innovation = position - bank.mean[row, :, 0]
        # the shift's expectation, not the innovation: after a gap most of that is the path's own uncertainty
        offset = innovation * settings.shift_spread**2 / (bank.cov[row, :, 0, 0] + sigma**2)
        bank.shift[row] += offset
        bank.add_event(row, Event(EventKind.SHIFT, interval, time, offset=offset))
    right = bank.take(np.arange(len(bank)))
    right.shift[:] = 0.0
    return [bank, right]


def departures(predicted: Bank, dt: float, scene: Scene, interval: int, time: float) -> list[Bank]:
    """The best resting prediction, in the air from now on."""
    if predicted.all_flying:
        return []
    bank = predicted.take(predicted.resting).take_best()
    height = scene.height(int(bank.surface[0]))
    lift(bank, scene)
    bank.score = bank.score - _rarity(scene.settings.hit_rate, dt) - scene.settings.leave_cost
    bank.age = np.zeros(1, dtype=np.int64)
    bank.add_event(0, Event(EventKind.LEAVE, interval, time, height))
    return [bank]


def _rested(bank: Bank, position: Array, scene: Scene, interval: int, time: float) -> list[Bank]:
    """A flying hypothesis as one that rests, for each surface that the sample is near."""
    rested = []
    for surface in (np.abs(position[2] - scene.centres) < scene.settings.rest_range).nonzero()[0]:
        down = bank.take([0])
        put_down(down, np.array([surface]), scene)
        down.score = down.score - scene.settings.start_at_rest_cost
        down.tips[0] = Node(Event(EventKind.REST, interval, time, scene.height(int(surface))), bank.tips[0])
        rested.append(down)
    return rested


def _rarity(rate: float, dt: float) -> float:
    """nats, minus log probability that an event of a rate (1/s) falls into an interval."""
    return -math.log(-math.expm1(-rate * max(dt, SHORTEST_STEP)))
