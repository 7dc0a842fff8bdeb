"""Chooses the strokes of a rally: hypotheses from the likeliest arcs, and their best sequence, joined at hits.

The score of a sequence is the logarithm of its probability against clutter alone. Sums over all sequences (forward and
backward, as for a hidden Markov model) give the probability of each stroke.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.estimation.rally.arcs import telling
from ballfg.estimation.rally.hits import Hits
from ballfg.estimation.rally.strokes import Grower, Stroke
from ballfg.parallel.parts import in_parts
from ballfg.progress import Watch, unwatched

KEPT: Final = 15
"""Arcs with the highest scores in each picture, of which strokes are grown."""
COMPARED: Final = 40
"""Strokes with the highest scores in each picture, of which sequences are made."""
BEGINS: Final = 8.0
"""Logarithm of what a stroke costs that no hit joins to the one before."""
MOST_BOUNCES: Final = 2
"""Of a stroke: a service has two."""
SERVED, PAUSE = 20.0, 0.5
"""Logarithm of what a second bounce costs so many s or less after another stroke: a service begins a rally. From behind
a player a hit at the far end may look like a bounce."""
VOLLEY: Final = 5.0
"""Logarithm of what it costs that a ball is hit which did not bounce before: rules forbid it, and of a bounce right
before a hit nothing may be seen."""
GAINED: Final = 0.1
"""Least gain of an exchange."""
EXCHANGED: Final = 4
"""Candidates at an end of a chosen stroke that are exchanged for others."""
TOGETHER: Final = 16
"""Flights that a process follows in turn."""
BESIDE: Final = 30
"""Flights of which strokes are grown where no hit joins a stroke to the next one: a hit's place tells of many flights
those that may go on from it."""
ROUNDS: Final = 6
"""Of exchanges in a sequence, until nothing improves."""


@dataclass(frozen=True, eq=False)
class Chosen:
    """The strokes of the best sequence, and whether a hit joins each to the one before.

    Attributes: probabilities: of each stroke and those like it, with as many bounces and most of its candidates.
    """

    strokes: tuple[Stroke, ...]
    probabilities: Array
    joined: tuple[bool, ...]


def promising(grower: Grower, flights: Sequence[Stroke]) -> list[Stroke]:
    """The flights with the highest scores, and among those that a ball in play could have."""
    # a swaying shoe is no flight, however smooth; an arc through a bounce becomes one with its bounce
    alone = _best_in_each(grower, flights, KEPT, 1, grower.plausible)
    return list({id(one): one for one in (*_best_in_each(grower, flights, KEPT, 1), *alone)}.values())


def hypotheses(grower: Grower, flights: Sequence[Stroke], watch: Watch = unwatched) -> list[Stroke]:
    """The strokes that grow from flights, highest scores first; of those with the same candidates only the best."""
    found = dict[tuple[int, ...], Stroke]()
    grown = watch(in_parts(partial(_variants, grower), flights, TOGETHER), len(flights), "possible flights followed")
    whole = [one for some in grown for one in some]
    likely = _best_in_each(grower, list({_key(one): one for one in whole}.values()), COMPARED)
    for stroke in (*whole, *(part for one in likely for part in grower.shortened(one))):
        known = found.get(_key(stroke))
        if (known is None or stroke.score > known.score) and grower.plausible(stroke):
            found[_key(stroke)] = stroke
    return _best_in_each(grower, sorted(found.values(), key=lambda one: -one.score), COMPARED)


def rally(grower: Grower, seeds: Sequence[Index], earlier: Sequence[Stroke] = (), watch: Watch = unwatched) -> Chosen:
    """The likeliest strokes of a rally, after exchanges of candidates and bounces in which nothing improves it.

    Args: seeds: arcs.  earlier: strokes that may be among them, from a search with other probabilities.
    """
    flights = grower.flights(seeds)
    rated = [grower.flown(stroke.rows, stroke.bounces) for stroke in earlier]
    begun = promising(grower, flights)
    known = {_key(stroke): stroke for stroke in (*rated, *hypotheses(grower, begun, watch))}
    done, followed, hits = set[tuple[int, ...]](), {id(flight) for flight in begun}, Hits(grower)
    for _ in range(ROUNDS):
        chosen = best_sequence(grower, hits, list(known.values()))
        fresh = [stroke for stroke in chosen.strokes if _key(stroke) not in done]
        done.update(map(_key, fresh))
        beside = {id(one): one for end in _open_ends(chosen) for one in _beside(hits, flights, *end)}
        new = [one for name, one in beside.items() if name not in followed]
        followed.update(beside)
        found = [*in_parts(partial(_exchanged, grower), fresh, 1)]
        found += in_parts(partial(_variants, grower), new, TOGETHER)
        for better in (one for some in found for one in some):
            old = known.get(_key(better))
            if (old is None or better.score > old.score) and grower.plausible(better):
                known[_key(better)] = better
        if not fresh and not new:
            break
    chosen = best_sequence(grower, hits, list(known.values()))
    return chosen if grower.field.play else with_others(grower, chosen, list(known.values()))


def with_others(grower: Grower, chosen: Chosen, strokes: Sequence[Stroke]) -> Chosen:
    """The strokes of a sequence, and after them those of other balls that fly meanwhile: they share no candidates.

    One that is likelier than all with which it shares candidates takes their place: a sequence cuts a stroke where that
    of another ball begins.
    """
    kept, holder = dict(enumerate(chosen.strokes)), dict[int, int]()
    holder.update((row, number) for number, one in kept.items() for row in one.rows.tolist())
    chances = dict(enumerate(chosen.probabilities.tolist()))
    for one in sorted(strokes, key=lambda stroke: -stroke.score):
        rivals = {holder[row] for row in one.rows.tolist() if row in holder}
        gain = one.score - BEGINS - sum(kept[number].score for number in rivals)
        if gain > GAINED and _shown(grower, one):
            number = len(chosen.strokes) + len(chances)
            for rival in rivals:
                for row in kept.pop(rival).rows.tolist():
                    del holder[row]
            kept[number], chances[number] = one, float(1.0 / (1.0 + np.exp(-gain)))
            holder.update((row, number) for row in one.rows.tolist())
    joined = [number < len(chosen.joined) and chosen.joined[number] and number - 1 in kept for number in kept]
    return Chosen(tuple(kept.values()), np.array([chances[number] for number in kept]), tuple(joined))


def _shown(grower: Grower, stroke: Stroke) -> bool:
    """True if a stroke without a hit is a ball's: it bounces or, where any flight counts, shows how it falls."""
    field = grower.field
    first, last = field.stamps[field.frame[stroke.rows[[0, -1]]]]
    return stroke.path.bounces > 0 or (not field.play and last - first >= telling(field))


def _open_ends(chosen: Chosen) -> list[tuple[Stroke, int]]:
    """The strokes that no hit joins to a later one (way 1) or to an earlier one (-1): there one may be missing."""
    joined = (*chosen.joined, False)
    last = [(stroke, 1) for stroke, on in zip(chosen.strokes, joined[1:], strict=True) if not on]
    return last + [(stroke, -1) for stroke, on in zip(chosen.strokes, joined[:-1], strict=True) if not on]


def _beside(hits: Hits, flights: Sequence[Stroke], stroke: Stroke, way: int) -> list[Stroke]:
    """The flights that most likely follow a stroke (way 1), or that it follows (-1), best first."""
    links = hits.between([stroke], flights)[0] if way > 0 else hits.between(flights, [stroke])[:, 0]
    rated = np.array([flight.score for flight in flights]) + links
    order = np.argsort(-rated, kind="stable")[:BESIDE]
    return [flights[number] for number in order if np.isfinite(rated[number])]


def _key(stroke: Stroke) -> tuple[int, ...]:
    """What tells strokes apart: their candidates and the number of their bounces."""
    return (*stroke.rows.tolist(), -len(stroke.bounces) - 1)


def _exchanged(grower: Grower, stroke: Stroke) -> list[Stroke]:
    """Better strokes than one, that have a bounce more or other candidates at an end."""
    parts = [stroke, *grower.shortened(stroke, EXCHANGED)]
    tried = [bounced for part in parts for way in (1, -1) for bounced in _bounced(grower, part, way)]
    tried += [grower.timed(one) for part in parts for one in grower.whole(part)]
    return [one for one in tried if one.score > stroke.score + GAINED and grower.plausible(one)]


def _variants(grower: Grower, flight: Stroke) -> list[Stroke]:
    """A flight without bounce, with one after or before it, and with one after and one before it."""
    found = grower.whole(flight)
    for way in (1, -1):
        for stroke in _bounced(grower, flight, way):
            found.append(stroke)
            found += _bounced(grower, stroke, -1) if way > 0 else []
    return found


def _bounced(grower: Grower, flight: Stroke, way: int) -> list[Stroke]:
    """The best strokes with one more bounce, if there are any."""
    if len(flight.bounces) == MOST_BOUNCES:
        return []
    best = max(grower.bounced(flight, way), key=lambda one: (grower.plausible(one), one.score), default=None)
    return [] if best is None else grower.whole(grower.timed(best))


def _best_in_each(
    grower: Grower,
    strokes: Sequence[Stroke],
    most: int,
    alike: int = -1,
    admitted: Callable[[Stroke], bool] = lambda stroke: True,
) -> list[Stroke]:
    """Those among the best `most` in one of their pictures, best first, without repeats of better ones.

    Args:
        alike: number of candidates, at most, by which a stroke differs from a better one that it repeats.
        admitted: says whether a stroke may take a place; asked of those alone that would take one.
    """
    taken, kept, holders = np.zeros(len(grower.field.first), dtype=np.int64), list[Stroke](), defaultdict[int, int](int)
    for stroke in sorted(strokes, key=lambda one: -one.score):
        first, last = grower.field.frame[stroke.rows[[0, -1]]]
        if taken[first : last + 1].min() >= most:
            continue
        near = [(1 << len(kept)) - 1] * (alike + 1)  # [n]: those kept, as bits, that lack at most n of its rows
        for row in stroke.rows.tolist() if near else ():
            for lacking in range(alike, 0, -1):
                near[lacking] = near[lacking] & holders[row] | near[lacking - 1]
            near[0] &= holders[row]
        if not any(near) and admitted(stroke):
            for row in stroke.rows.tolist():
                holders[row] |= 1 << len(kept)
            kept.append(stroke)
            taken[first : last + 1] += 1
    return kept


def best_sequence(grower: Grower, hits: Hits, strokes: Sequence[Stroke]) -> Chosen:
    """The likeliest sequence of strokes that follow each other."""
    ordered = sorted(strokes, key=lambda one: int(grower.field.frame[one.rows[-1]]))
    count = len(ordered)
    if not count:
        return Chosen((), np.zeros(0), ())
    first, last = (grower.field.frame[[one.rows[end] for one in ordered]] for end in (0, -1))
    score = np.array([one.score for one in ordered])
    begins = np.where([_shown(grower, one) for one in ordered], -BEGINS, -np.inf)  # else it may be anything
    later = first > last[:, None]
    soon = grower.field.stamps[first] - grower.field.stamps[last][:, None] < PAUSE
    # without a hit between them a ball in play was there unseen, or a new rally began at once
    unseen = np.minimum(-np.log(1.0 - grower.field.seen) * (first - last[:, None] - 1), SERVED)
    alone = np.where(later, begins - np.where(soon, unseen, 0.0), -np.inf)
    bounces = np.array([one.path.bounces for one in ordered])
    met = np.where(later, hits.between(ordered, ordered) - VOLLEY * (bounces == 0)[:, None], -np.inf)
    served = SERVED * (soon & (bounces == MOST_BOUNCES) & (bounces > 0)[:, None])  # a toss before it is no stroke
    link = np.maximum(alone, met) - served
    best, before = score + begins, np.full(count, -1)
    forward, backward = score + begins, np.zeros(count)
    for j in range(count):
        ways = best[:j] + link[:j, j]
        if j and ways.max() > begins[j]:
            before[j] = int(np.argmax(ways))
            best[j] = ways.max() + score[j]
        forward[j] = score[j] + np.logaddexp.reduce(np.append(forward[:j] + link[:j, j], begins[j]))
    for i in range(count - 1, -1, -1):
        backward[i] = np.logaddexp.reduce(np.append(link[i] + score + backward, 0.0))
    total = np.logaddexp.reduce(np.append(forward, 0.0))
    chain, at = list[int](), int(np.argmax(best))
    while best.max() > 0.0 and at >= 0:
        chain.append(at)
        at = int(before[at])
    chain.reverse()
    likely, sets = np.exp(forward + backward - total), [frozenset(one.rows.tolist()) for one in ordered]

    def alike(i: int, j: int) -> bool:
        shared = 2 * len(sets[i] & sets[j])
        return shared > len(sets[i]) and shared > len(sets[j]) and bounces[i] == bounces[j]

    # no sequence holds two strokes that are like a third one: their probabilities add up
    probabilities = np.array([likely[[j for j in range(count) if alike(i, j)]].sum() for i in chain])
    joined = (False, *(bool(met[i, j] > alone[i, j]) for i, j in pairwise(chain)))[: len(chain)]
    return Chosen(tuple(ordered[i] for i in chain), np.minimum(probabilities, 1.0), joined)
