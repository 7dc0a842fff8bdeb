"""Chooses the strokes of a rally: hypotheses from the likeliest arcs, their best sequence, and what improves it."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

import numpy as np

from ballfg.arrays import Index
from ballfg.estimation.rally.hits import Hits
from ballfg.estimation.rally.sequence import BEGINS, MOST_BOUNCES, Chosen, best_sequence, shown_to_fall
from ballfg.estimation.rally.strokes import Grower, Stroke
from ballfg.parallel.parts import in_parts
from ballfg.progress import Watch, unwatched

KEPT: Final = 15
"""Arcs with the highest scores in each picture, of which strokes are grown."""
COMPARED: Final = 40
"""Strokes with the highest scores in each picture, of which sequences are made."""
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
    # of all, and of those that a ball in play could have: a swaying shoe is no flight, however smooth, and an arc
    # through a bounce becomes one with its bounce
    alone = _best_in_each(grower, flights, KEPT, 1, grower.plausible)
    begun = list({id(one): one for one in (*_best_in_each(grower, flights, KEPT, 1), *alone)}.values())
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
        if gain > GAINED and shown_to_fall(grower, one):
            number = len(chosen.strokes) + len(chances)
            for rival in rivals:
                for row in kept.pop(rival).rows.tolist():
                    del holder[row]
            kept[number], chances[number] = one, float(1.0 / (1.0 + np.exp(-gain)))
            holder.update((row, number) for row in one.rows.tolist())
    joined = [number < len(chosen.joined) and chosen.joined[number] and number - 1 in kept for number in kept]
    return Chosen(tuple(kept.values()), np.array([chances[number] for number in kept]), tuple(joined))


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
