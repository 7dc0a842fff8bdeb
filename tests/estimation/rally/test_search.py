"""Arcs, strokes, hits and their best sequence, against planted truth, closed forms and all sequences one by one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm

from ballfg.benchmarks.cameras.films import Truth
from ballfg.estimation.observations.bounced_path import places_of
from ballfg.estimation.rally import hits as hits_of
from ballfg.estimation.rally.arcs import Foretold
from ballfg.estimation.rally.field import SIZE_SIGMA, SIZES, STRAY
from ballfg.estimation.rally.growth import halves, rated
from ballfg.estimation.rally.hits import Hits
from ballfg.estimation.rally.sequence import BEGINS, MOST_BOUNCES, PAUSE, SERVED, VOLLEY, best_sequence
from ballfg.estimation.rally.strokes import LEAST, Grower, Stroke
from ballfg.state import POSITION
from ballfg.vision.broadcast.motion import Shot
from tests.estimation.rally.planted import grower_of, planted, true_stroke


@pytest.fixture(scope="module", params=["side", "behind"])
def made(request: pytest.FixtureRequest) -> tuple[Truth, Shot, Grower, list[Any]]:
    of, motion, found = planted(request.param, 11)
    return of, motion.shots[0], *grower_of(found, motion.shots[0])


def test_the_path_through_a_balls_candidates_is_where_it_flew(made: tuple[Truth, Shot, Grower, list[Any]]) -> None:
    of, shot, grower, _ = made
    for number in range(3):
        stroke, bounce = true_stroke(of, number, grower, shot)
        times = grower.scene.rays.times[stroke.rows]
        assert len(times) >= 8
        true = np.array([state[POSITION] for state in map(of.at, times.tolist()) if state is not None])
        places, spread = places_of(grower.scene, stroke.path, 0, times)
        assert np.median(np.linalg.norm(places - true, axis=1)) < 0.12
        assert (np.linalg.eigvalsh(spread) > 0.0).all()
        pixels = shot.cameras[0].project(places)
        assert np.sqrt(((pixels - shot.cameras[0].project(true)) ** 2).mean()) < 1.5
        assert grower.plausible(stroke)
        # its bounce is found again from a picture beside it
        moved = grower.timed(grower.flown(stroke.rows, (bounce + 0.03,)))
        assert moved.bounces[0] == pytest.approx(bounce, abs=0.012)


@pytest.mark.parametrize("number", range(3))
def test_a_flight_goes_on_past_a_bounce_after_which_a_picture_lacks_the_ball(number: int) -> None:
    of, motion, found = planted("behind", 12)
    stroke, bounce = true_stroke(of, number, grower_of(found, motion.shots[0])[0], motion.shots[0])
    hidden = stroke.rows[found.times[stroke.rows] > bounce][0]
    grower, _ = grower_of(found.select(np.arange(len(found)) != hidden), motion.shots[0])
    rows = true_stroke(of, number, grower, motion.shots[0])[0].rows
    flight = grower.flown(rows[grower.scene.rays.times[rows] < bounce], ())
    best = max(grower.bounced(flight, 1), key=lambda one: one.score)
    assert set(rows.tolist()) <= set(best.rows.tolist())
    assert best.bounces[0] == pytest.approx(bounce, abs=grower.field.step)


def test_most_arcs_of_a_ball_are_found_and_they_are_smooth(made: tuple[Truth, Shot, Grower, list[Any]]) -> None:
    of, shot, grower, seeds = made
    for number in range(3):
        rows = set(true_stroke(of, number, grower, shot)[0].rows.tolist())
        assert max(len(rows & set(seed.tolist())) for seed in seeds) >= 0.4 * len(rows)
    assert all((np.diff(grower.field.frame[seed]) > 0).all() for seed in seeds)


def test_a_stroke_that_flies_past_the_wrong_half_costs_as_much_as_it_says(
    made: tuple[Truth, Shot, Grower, list[Any]],
) -> None:
    of, shot, grower, _ = made
    stroke, bounce = true_stroke(of, 0, grower, shot)
    *_, scene, view = grower._seen
    path = rated(*grower._seen, stroke.rows, np.array([bounce])).path
    vectors = path.vectors * np.array([-1.0, 1.0, 1.0])  # as far on the other half
    vectors[1:] *= np.array([-1.0, 1.0, 1.0])
    assert halves(scene, view, np.array([bounce]), 1, path) == pytest.approx(0.0, abs=0.05)
    assert halves(scene, view, np.array([bounce]), 1, path._replace(vectors=vectors)) == pytest.approx(5.0, abs=0.2)


def test_a_stroke_grows_from_three_of_its_candidates_and_has_those_between(
    made: tuple[Truth, Shot, Grower, list[Any]],
) -> None:
    of, shot, grower, _ = made
    whole, bounce = true_stroke(of, 0, grower, shot)
    rows = whole.rows[grower.scene.rays.times[whole.rows] < bounce]
    known = {tuple(one.rows.tolist()) for one in grower.whole(grower.flown(rows[[0, 2, 4]], ()))}
    assert any(set(rows.tolist()) <= set(one) for one in known)
    (together, *_) = grower.flights([rows[[0, 2, 4]], rows[:4], rows[[1, 3, 4]]])
    alone = grower.flown(rows[[0, 2, 4]], ())
    assert together.score == pytest.approx(alone.score, abs=1e-6)
    np.testing.assert_allclose(together.path.vectors, alone.path.vectors, rtol=1e-6, atol=1e-8)


def test_shortened_strokes_lose_one_end_each(made: tuple[Truth, Shot, Grower, list[Any]]) -> None:
    of, shot, grower, _ = made
    stroke, _ = true_stroke(of, 0, grower, shot)
    parts = list(grower.shortened(stroke, 3))
    assert len(parts) == 6
    for part in parts:
        assert len(part.rows) >= LEAST
        assert part.rows[0] == stroke.rows[0] or part.rows[-1] == stroke.rows[-1]
        assert set(part.rows.tolist()) < set(stroke.rows.tolist())


def test_a_hit_is_as_likely_as_the_normal_density_of_what_parts_the_paths(
    made: tuple[Truth, Shot, Grower, list[Any]],
) -> None:
    of, shot, grower, _ = made
    strokes = [true_stroke(of, number, grower, shot)[0] for number in range(3)]
    found = Hits(grower).between(strokes, strokes)
    assert np.isneginf(found[np.tril_indices(3)]).all()
    for i in range(2):
        one, other = strokes[i], strokes[i + 1]
        ends = grower.scene.rays.times[[one.rows[-1], other.rows[0]]]
        moments = np.linspace(*ends, hits_of.MOMENTS)
        pairs = [places_of(grower.scene, stroke.path, 0, moments) for stroke in (one, other)]
        density = [
            multivariate_normal(place, first + second + hits_of.HIT_SIGMA**2 * np.eye(3)).logpdf(other_place)
            for place, first, other_place, second in zip(*pairs[0], *pairs[1], strict=True)
        ]
        onward = one.path.vectors[0, 2, 0] * other.path.vectors[0, 1, 0] > 0.0
        assert not onward
        field = grower.field
        missed = field.frame[other.rows[0]] - field.frame[one.rows[-1]] - 1
        going_on = np.exp(-field.step / hits_of.HIDDEN)  # of the hiding; else the ball is seen, or missed by chance
        hidden = missed * np.log(going_on + (1.0 - going_on) * (1.0 - field.seen))
        assert found[i, i + 1] == pytest.approx(max(density) + np.log(hits_of.ROOM) - hits_of.HIT + hidden)
    assert found[0, 1] > 0.0
    again = replace(strokes[1], path=replace(strokes[1].path, vectors=-strokes[1].path.vectors))
    assert Hits(grower).between(strokes[:1], [again])[0, 0] < found[0, 1]


class Given:
    """Hits whose likelihoods are given."""

    def __init__(self, table: Any) -> None:
        self.table = table

    def pairs(self, strokes: list[Any], later: list[Any], before: Any, after: Any) -> Any:
        return self.table[[strokes[i].number for i in before], [later[j].number for j in after]]


@pytest.mark.parametrize("seed", range(6))
def test_the_best_sequence_and_its_probabilities_are_those_of_all_sequences(seed: int) -> None:
    rng, count = np.random.default_rng(seed), 7
    first = rng.integers(0, 20, count)
    first[5:] = first[:2] + 1  # so that two are like earlier ones
    last = first + rng.integers(3, 9, count)
    frame, stamps = np.arange(50), 0.04 * np.arange(50)
    grower: Any = SimpleNamespace(field=SimpleNamespace(frame=frame, stamps=stamps, seen=0.6 + 0.05 * seed, play=True))
    gap = stamps[first] - stamps[last][:, None]
    assert hits_of.LONGEST_HIT < PAUSE
    table = np.where(gap <= hits_of.LONGEST_HIT, rng.normal(0.0, 6.0, (count, count)), -np.inf)
    strokes: list[Any] = [
        SimpleNamespace(
            rows=np.arange(a, b + 1),
            score=float(rng.uniform(0.0, 12.0)),
            path=SimpleNamespace(bounces=int(rng.integers(0, 3)) if number < 5 else 1),
            number=number,
        )
        for number, (a, b) in enumerate(zip(first, last, strict=True))
    ]
    hits: Any = Given(table)
    chosen = best_sequence(grower, hits, strokes)

    def begins(one: Any) -> float:
        return -BEGINS if one.path.bounces else -np.inf

    def value(chain: tuple[Any, ...]) -> float:
        total = begins(chain[0]) + chain[0].score
        for before, after in pairwise(chain):
            pause = stamps[after.rows[0]] - stamps[before.rows[-1]]
            unseen = -np.log(1.0 - grower.field.seen) * (after.rows[0] - before.rows[-1] - 1)
            alone = begins(after) - min(unseen, SERVED) * (pause < PAUSE)
            link = max(alone, table[before.number, after.number] - VOLLEY * (before.path.bounces == 0))
            served = after.path.bounces == MOST_BOUNCES and before.path.bounces > 0
            total += link - SERVED * (pause < PAUSE and served) + after.score
        return total

    def chains() -> Iterator[tuple[Any, ...]]:
        ordered = sorted(strokes, key=lambda one: one.rows[-1])
        for size in range(1, count + 1):
            for some in combinations(ordered, size):
                if all(after.rows[0] > before.rows[-1] for before, after in pairwise(some)):
                    yield some

    values = {chain: value(chain) for chain in ((*map(Hashable, one),) for one in chains())}
    best = max(values, key=lambda chain: values[chain])
    total = logsumexp([*values.values(), 0.0])
    if values[best] <= 0.0:
        assert not chosen.strokes
        return
    assert [one.number for one in chosen.strokes] == [one.number for one in best]

    def like(one: Any, other: Any) -> bool:
        shared = len(set(one.rows.tolist()) & set(other.rows.tolist()))
        return one.path.bounces == other.path.bounces and shared > max(len(one.rows), len(other.rows)) / 2

    for one, chance in zip(chosen.strokes, chosen.probabilities, strict=True):
        mine = [score for chain, score in values.items() if any(like(one, other) for other in chain)]
        assert chance == pytest.approx(np.exp(logsumexp(mine) - total), abs=1e-9)


class Hashable:
    """A stroke as a key."""

    def __init__(self, one: Any) -> None:
        self.rows, self.score, self.path, self.number = one.rows, one.score, one.path, one.number


def test_the_density_of_clutter_leaves_the_ball_out() -> None:
    rows = [[0, 1, 2], [1, 2, 3], [10, 11, 12], [20, 21, 22]]
    counted = Foretold(rows, [True, True, False, True], [4.0, 4.0, 5.0, 5.0])
    assert counted.density(np.array([], dtype=np.int64)) == pytest.approx((3 + 1) / 18.0)
    assert counted.density(np.array([2])) == pytest.approx((1 + 1) / 10.0)


def test_strokes_are_told_apart_by_their_score(made: tuple[Truth, Shot, Grower, list[Any]]) -> None:
    """Candidates that are the ball beat as many false ones of the same pictures."""
    of, shot, grower, _ = made
    stroke, bounce = true_stroke(of, 1, grower, shot)
    false = np.array([grower.field.rows(int(frame))[0] for frame in grower.field.frame[stroke.rows]])
    wrong: Stroke = grower.flown(false, (bounce,))
    assert stroke.score > 20.0
    assert wrong.score < 0.0


def test_radii_count_as_much_as_a_balls_are_denser_than_those_of_all_candidates() -> None:
    of, motion, found = planted("side", 11)
    shot, rng = motion.shots[0], np.random.default_rng(4)
    plain, _ = grower_of(found, shot)
    stroke, bounce = true_stroke(of, 0, plain, shot)
    times, camera = plain.scene.rays.times[stroke.rows], plain.camera
    depth = places_of(plain.scene, stroke.path, 0, times)[0] @ camera.rotation[2] + camera.tvec[2]
    foretold = camera.matrix[0, 0] * plain.scene.physics.radius / depth
    radii = np.exp(rng.uniform(np.log(2.0), np.log(20.0), len(found)))
    radii[stroke.rows] = 1.1 * foretold
    radii[stroke.rows[0]] = 3.0 * foretold[0]  # a shirt behind it
    sigma = 0.1 * radii
    unknown = int(stroke.rows[1])
    given = np.stack((np.where(np.arange(len(found)) == unknown, 0.0, radii), sigma), axis=1)
    grower, _ = grower_of(replace(found, radii=given), shot)
    sized = grower.flown(stroke.rows, (bounce,))
    field, known = grower.field, given[:, 0] > 0.0
    step = np.floor(np.log(radii) / SIZES)
    among = step[known]
    shares = [(among == one).sum() + 1.0 for one in step] / (len(among) + among.max() - among.min() + 1.0)
    common = shares / SIZES
    np.testing.assert_allclose(field.common[known], common[known])
    assert field.common[unknown] == 0.0
    ball = norm(np.log(foretold), np.sqrt(0.1**2 + SIZE_SIGMA**2)).pdf(np.log(radii[stroke.rows]))
    gain = np.log(STRAY + (1.0 - STRAY) * ball / common[stroke.rows])[known[stroke.rows]]
    assert sized.score - stroke.score == pytest.approx(gain.sum(), rel=1e-3)
    assert gain[0] == pytest.approx(np.log(STRAY), abs=0.1)
    assert gain[1:].min() > 0.5
