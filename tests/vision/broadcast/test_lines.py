"""Ridges of lines: in the middle between unlike grounds, none where another line is in the way; their factor."""

from dataclasses import replace

import cv2
import gtsam
import numpy as np
import pytest

from ballfg.benchmarks.cameras.hall import COURT, looking, picture
from ballfg.vision.broadcast import graph
from ballfg.vision.broadcast.background import Match
from ballfg.vision.broadcast.lines import CROSSING, FLANK, _brightest, brightness, moved, ridges
from ballfg.vision.broadcast.measured import (
    LENS,
    LINES,
    NEAR,
    READOUT,
    ROBUST,
    Background,
    CourtLines,
    Flow,
    Noise,
    place_key,
    turn_key,
    zoom_key,
)

PLACES = np.array([[100.0, 80.0], [800.0, 120.0], [500.0, 300.0], [150.0, 450.0]])
STILL = Match(PLACES, PLACES, np.eye(3))
CAMERA = looking((0.5, -7.0, 3.0), (0.0, 0.0, 0.0), 1000.0)


@pytest.fixture(scope="module")
def seen():
    """Ridges of pictures with the half resolution of colour that videos have, at the true camera."""
    packed = [picture(CAMERA, np.random.default_rng(seed)) for seed in range(8)]
    flat = [cv2.cvtColor(image, cv2.COLOR_BGR2YUV_I420) for image in packed]
    return [ridges(brightness(cv2.cvtColor(one, cv2.COLOR_YUV2BGR_I420)), CAMERA, COURT, 3.0) for one in flat]


def test_a_line_lies_in_the_middle_whatever_the_ground_on_both_sides(seen):
    """The table's edges have the blue table on one side and the dark floor on the other."""
    for line in range(4):
        off = np.concatenate([one.offset[one.line == line] for one in seen])
        assert abs(np.median(off)) < 0.04
        assert np.percentile(np.abs(off), 90) < 0.5


@pytest.mark.parametrize("grounds", [(40.0, 80.0), (80.0, 40.0), (60.0, 60.0)])
@pytest.mark.parametrize("width", [0.8, 1.5, 3.0])
@pytest.mark.parametrize("blur", [0.7, 1.1])
def test_the_middle_of_a_blurred_bar_between_unlike_grounds(grounds, width, blur):
    """A profile sampled finely, blurred by a Gaussian and seen by pixels: no formula of a halfway place."""
    rng, fine = np.random.default_rng(2), 40
    u = (np.arange(60 * fine) + 0.5) / fine - 0.5
    off = []
    for middle in 30.0 + rng.uniform(-0.5, 0.5, 40):
        bar = np.where(u < middle, *grounds)
        bar[np.abs(u - middle) < 0.5 * width] = 220.0
        seen = cv2.GaussianBlur(bar[None], (0, 0), blur * fine).reshape(60, fine).mean(axis=1)
        image = np.tile(seen.astype(np.float32), (5, 1))
        at, normal = np.array([[30.0, 2.0]]), np.array([[1.0, 0.0]])
        found, good = _brightest(image, at, normal, 3.0, np.array([width]))
        off += [found[0] - (middle - 30.0)] if good[0] else []
    assert len(off) > 35
    assert abs(np.mean(off)) < 0.02


def test_the_noise_is_that_with_which_the_residuals_are_most_probable(seen):
    """Against a search over the density of which Cauchy's loss is the logarithm."""
    rng, sigmas = np.random.default_rng(4), np.array([0.05, 0.1, 0.2, 0.08, 0.3, 0.15])
    drawn = [replace(one, offset=rng.standard_t(3, len(one.line)) * sigmas[one.line]) for one in seen]
    cameras, still = [CAMERA] * len(drawn), [STILL] * (len(drawn) - 1)
    problem = graph.Problem(cameras, drawn, still)
    values = problem.first(cameras, moves=False)

    def left_by(noise):
        batches = CourtLines(cameras, drawn, noise), Background(cameras, still, noise)
        return graph.Fit(problem, noise, *batches, graph._graph(*batches, values, noise), values)

    noise = Noise(np.full(6, 0.1), 0.03, 0.15)
    for _ in range(60):
        noise = graph._noise(left_by(noise))
    tried = np.geomspace(0.02, 1.0, 2000)
    for line in range(6):
        left = np.concatenate([one.offset[one.line == line] for one in drawn])
        cost = [0.5 * ROBUST**2 * np.log1p((left / s / ROBUST) ** 2).sum() + len(left) * np.log(s) for s in tried]
        assert noise.ridges[line] == pytest.approx(tried[int(np.argmin(cost))], rel=0.005)
    assert noise.lines < graph.LINE_SIGMA * 1.5


def test_no_ridge_is_sought_where_another_line_is_in_the_way(seen):
    """The middle line has none where it meets the edges, nor below the upper edge of the net."""
    ends = CAMERA.project(COURT.lines)
    for number, (first, second) in enumerate(ends):
        others = np.concatenate([one.points[one.line != number] for one in seen])
        pixels, along = CAMERA.project(others), second - first
        share = np.clip((pixels - first) @ along / (along @ along), 0.0, 1.0)
        assert np.linalg.norm(pixels - first - share[:, None] * along, axis=1).min() > CROSSING * FLANK - 1e-9
    middle = np.concatenate([one.points[one.line == 4, 0] for one in seen])
    assert 0 < len(middle) < 8 * 24


@pytest.mark.parametrize(("walk", "readout"), [(0.0, 0.0), (0.01, 0.0), (0.01, 0.5)])
def test_derivatives_of_the_factors_are_those_of_differences(seen, walk, readout):
    """Of ridges and background of two pictures, of a standing, a moving, a rolling camera, and at new values anew."""
    likes = [looking((0.5, -7.02, 3.0), (0.02 * k, 0.0, 0.0), 1003.0 + 9.0 * k) for k in range(2)]
    noise = Noise(np.linspace(0.05, 0.2, len(COURT.lines)), 0.03, 0.15, walk, readout)
    values, widths = gtsam.Values(), {LENS: 1, LINES: len(COURT.lines)}
    values.insert(LENS, np.array([-0.02]))
    values.insert(LINES, np.linspace(-0.3, 0.3, len(COURT.lines)))
    for k, like in enumerate(likes):
        values.insert(turn_key(k), gtsam.Rot3(like.turn.T))
        values.insert(zoom_key(k), np.array([np.log(like.focal)]))
        widths |= {turn_key(k): 3, zoom_key(k): 1}
    if walk:
        values.insert(NEAR, np.array([0.12]))
        widths |= {NEAR: 1}
    if readout:
        values.insert(READOUT, np.array([0.3]))
        widths |= {READOUT: 1}
    flow = Flow(likes, 0.1) if readout else None
    for k in range(2 if walk else 1):
        values.insert(place_key(k, walk > 0.0), gtsam.Point3(likes[0].place + 0.03 * k))
        widths |= {place_key(k, walk > 0.0): 3}
    far = Match(PLACES, likes[0].onto(PLACES, likes[1]) + 0.2, np.eye(3))
    court, background = CourtLines(likes, seen[:2], noise, flow), Background(likes, [far], noise, flow)
    for factor in (court.factor(0), court.factor(1), background.factor(0)):
        keys, column = factor.keys(), 0
        found = factor.linearize(values).jacobian()[0] * factor.noiseModel().sigma()
        for key in keys:
            for number in range(widths[key]):
                ends = []
                for way in (1e-6, -1e-6):
                    step = gtsam.VectorValues()
                    for other, count in widths.items():
                        step.insert(other, way * np.eye(count)[number] if other == key else np.zeros(count))
                    ends.append(factor.unwhitenedError(values.retract(step)))
                np.testing.assert_allclose(found[:, column], (ends[0] - ends[1]) / 2e-6, atol=1e-4, rtol=1e-5)
                column += 1
        assert column == found.shape[1]


@pytest.mark.parametrize("readout", [0.0, 0.5])
def test_a_rolling_shutter_is_found_from_a_pan_that_changes(seen, readout):
    """Each row is seen by the camera that turns on to its moment; nothing else is read from the pan."""
    rng, count = np.random.default_rng(11), 40
    angle = 0.06 * np.sin(np.arange(-1.0, count + 1.0) / 4.0)

    def at(moment):
        turn = np.interp(moment, np.arange(-1.0, count + 1.0), angle)
        return moved(CAMERA, np.array([0.0, turn, 0.0, 0.0, 0.0, 0.0, 0.0]))

    def shown(number, points):
        """Pixels of places (n, 3) m in a picture, each as the camera stands when its row is read."""
        pixels = at(number).project(points)
        for _ in range(5):
            late = readout * ((pixels[:, 1] + 0.5) / CAMERA.size[1] - 0.5)
            pixels = np.stack([at(number + one).project(point) for one, point in zip(late, points, strict=True)])
        return pixels

    cameras, links, court = [at(k) for k in range(count)], [], []
    far = CAMERA.place + 12.0 * CAMERA.directions(rng.uniform((100, 50), (860, 490), (60, 2))) @ CAMERA.turn
    for k, camera in enumerate(cameras):
        off = shown(k, seen[0].points) - camera.project(seen[0].points)
        ends = camera.project(COURT.lines)[seen[0].line]
        along = ends[:, 1] - ends[:, 0]
        normal = np.stack((-along[:, 1], along[:, 0]), axis=1) / np.linalg.norm(along, axis=1)[:, None]
        court.append(replace(seen[0], normal=normal, offset=(normal * off).sum(axis=1) + rng.normal(0, 0.1, len(off))))
        pair = [shown(one, far) + rng.normal(0.0, 0.1, far[:, :2].shape) for one in (max(k - 1, 0), k)]
        links += [Match(*pair, np.eye(3))] if k else []
    found = graph.solve(cameras, court, links).unknowns
    assert found.readout == pytest.approx(readout, abs=0.1)
    assert (found.readout == 0.0) == (readout == 0.0)
    assert found.near == 0.0
