"""The judge of rendered rallies, on a rally that is known, and the rows of given scores.

Drawn polygons and bars: their middle, width and area in a picture against geometry.
"""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from ballfg.benchmarks.cameras.films import Filmed, film, pictures
from ballfg.benchmarks.cameras.hall import SIZE, _barred, _filled, looking
from ballfg.benchmarks.cameras.rallies import Score, add_rally, camera_judged, judged
from ballfg.benchmarks.results import Results
from ballfg.estimation.rally.events import events_in_play
from ballfg.estimation.rally.reconstruct import reconstruct
from ballfg.state import POSITION
from ballfg.vision.broadcast.pinhole import Pinhole
from ballfg.vision.detection.video import open_video
from tests.estimation.rally.planted import MODEL, POSE_SIGMAS, RATE, SURFACES, planted


def test_strokes_of_a_known_rally_are_found_and_those_of_another_are_false() -> None:
    of, motion, found = planted("side", 21)
    one = reconstruct(found, motion.shots[0], MODEL, SURFACES)
    events = events_in_play(one, MODEL, SURFACES, 1.0 / RATE, 0.1525)
    score = judged(one.estimates, events, of)
    assert (score.found, score.false) == (len(one.estimates), 0)
    assert max(score.errors) < 0.3
    assert score.bounces[0] == score.found
    assert np.mean(score.held) > 0.6
    right, asked, sure, known = score.spins
    assert sure <= min(right, known) <= asked
    other, *_ = planted("behind", 4)
    wrong = judged(one.estimates, events, other)
    assert wrong.found + wrong.false == len(one.estimates)
    assert wrong.false > 0


def test_the_errors_of_a_camera_are_shares_of_its_place_and_focal_length() -> None:
    of, motion, _ = planted("side", 21)
    (shot,) = motion.shots
    true = of.cameras[0]
    off = Pinhole(true.turn, true.place + POSE_SIGMAS[3] * np.eye(3)[0], 1.02 * true.focal, true.size, true.bend)
    cameras = (off, *of.cameras[1 : len(shot)])
    score = camera_judged(replace(shot, cameras=cameras), of)
    assert score.place == pytest.approx(POSE_SIGMAS[3] / np.linalg.norm(true.place))
    assert score.focal == pytest.approx(np.log(1.02))
    assert score.held == [True, True, True, False, True, True]


def test_rows_are_the_sums_of_all_rallies() -> None:
    results = Results("cameras", 0)
    scores = [
        Score(4, 3, 1, [0.02, 0.03, 0.04], [True, True, False], (2, 3, 1, 1), (3, 4)),
        Score(2, 2, 0, [0.05, 0.06], [True], (1, 1, 0, 0), (2, 2)),
    ]
    add_rally(results, "case", scores)
    values = {row.metric: (row.value, row.n) for row in results.rows}
    assert values == {
        "strokes_found": (5 / 6, 6),
        "false_strokes": (1 / 6, 6),
        "bounces_found": (5 / 6, 6),
        "spin_sign": (3 / 4, 4),
        "position_rmse": (pytest.approx(40.0), 5),
        "coverage_90": (3 / 4, 4),
    }
    nothing = Results("cameras", 0)
    add_rally(nothing, "case", [Score(4, 0, 0, [], [], (0, 0, 0, 0), (0, 4))])
    assert {row.metric: row.value for row in nothing.rows if row.value is not None} == {
        "strokes_found": 0.0,
        "bounces_found": 0.0,
    }


def test_a_film_has_a_picture_for_each_camera(tmp_path: Path) -> None:
    of, *_ = planted("near", 3)
    film(replace(of, cameras=of.cameras[:6]), tmp_path / "rally.mp4", RATE, 3)
    assert open_video(tmp_path / "rally.mp4").count == 6


def test_a_minute_before_a_camera_that_stands_has_pauses_and_a_ball_that_is_hidden_at_times() -> None:
    of = Filmed(3, 10.0, stands=True).truth
    assert all(one is of.cameras[0] for one in of.cameras)
    assert len(of.cameras) == 600
    gaps = np.array([after.begin - one.end for one, after in pairwise(of.strokes)])
    assert ((gaps == 0.0) | ((gaps > 1.5) & (gaps < 3.0))).all()
    assert (gaps == 0.0).any()
    assert (gaps > 0.0).any()
    assert of.strokes[-1].end < 60.0
    assert 0.08 < len(of.hidden) / len(of.cameras) < 0.25  # of 600 pictures bursts hide more than of 3,000

    def ball(hidden: frozenset[int]) -> float:
        """Grey levels by which the ball brightens a picture in which it is 4 m away."""
        number = next(k for k in range(600) if of.at(k / 10.0) is not None)
        one = replace(of, cameras=of.cameras[: number + 1], hidden=hidden, light=1.0, quality=100)
        (u, v) = of.cameras[0].project(of.at(number / 10.0)[POSITION])
        *_, last = pictures(one, 10.0, 3)
        return float(last[int(v) - 1 : int(v) + 2, int(u) - 1 : int(u) + 2].max())

    every = frozenset(range(600))
    assert ball(frozenset()) > ball(every) + 50.0


FLOOR, COLOUR = 20.0, 220.0
ABOVE = looking((0.0, -0.01, 10.0), (0.0, 0.0, 0.0), 1000.0)


def shares(camera: Pinhole, corners: np.ndarray) -> np.ndarray:
    """(h, w), how much of each pixel a polygon (n, 3) m covers."""
    image = np.full((SIZE[1], SIZE[0], 3), FLOOR, dtype=np.uint8)
    _filled(image, camera, corners, (COLOUR, COLOUR, COLOUR))
    return (image[..., 1] - FLOOR) / (COLOUR - FLOOR)


@pytest.mark.parametrize("degrees", [3.0, 20.0, 40.0, 87.0])
@pytest.mark.parametrize("width", [0.6, 2.4])
def test_a_line_lies_where_it_is_projected_and_is_as_wide(degrees, width):
    rng, angle = np.random.default_rng(1), np.radians(degrees)
    along, across = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([-np.sin(angle), np.cos(angle), 0.0])
    for turned in (1, -1):
        middle, half = np.append(rng.uniform(-0.005, 0.005, 2), 0.0), 0.005 * width * across
        line = [middle - along - half, middle + along - half, middle + along + half, middle - along + half]
        seen = shares(ABOVE, np.array(line)[::turned])
        v, u = np.mgrid[: SIZE[1], : SIZE[0]]
        ends = ABOVE.project(np.stack((middle - along, middle + along)))
        way = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        off = np.stack((u, v), axis=2) - ends.mean(axis=0)
        inner = np.where(np.abs(off @ way) < 60.0, seen, 0.0)
        assert abs((inner * (off @ [-way[1], way[0]])).sum() / inner.sum()) < 0.02
        assert seen.sum() == pytest.approx(width * 200.0, rel=0.03)


def test_a_line_that_a_lens_bends_follows_it():
    bent = looking((0.0, -0.01, 10.0), (0.0, 0.0, 0.0), 1000.0, 0.3)
    seen = shares(bent, np.array([[-3.0, 1.99, 0.0], [3.0, 1.99, 0.0], [3.0, 2.01, 0.0], [-3.0, 2.01, 0.0]]))
    for x in np.linspace(-2.8, 2.8, 9):
        u, v = bent.project(np.array([[x, 2.0, 0.0]]))[0]
        column = seen[:, round(u)]
        assert (column * np.arange(SIZE[1])).sum() / column.sum() == pytest.approx(v, abs=0.15)


def test_a_bar_has_the_area_of_a_rectangle_and_two_half_circles():
    image = np.zeros((SIZE[1], SIZE[0], 3), dtype=np.uint8)
    ends, radius = np.array([[100.3, 50.2], [117.1, 61.8]]), 2.3
    _barred(image, ends, radius, (COLOUR, COLOUR, COLOUR))
    area = np.pi * radius**2 + 2.0 * radius * np.linalg.norm(ends[1] - ends[0])
    share = image[..., 1] / COLOUR
    assert share.sum() == pytest.approx(area, rel=0.02)
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    middle = [(share * u).sum() / share.sum(), (share * v).sum() / share.sum()]
    np.testing.assert_allclose(middle, ends.mean(axis=0), atol=0.02)
