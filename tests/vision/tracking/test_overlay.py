"""The pictures of a recording: the right frame of each camera at each time, the ball marked where it is."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.collections import EllipseCollection
from numpy.typing import NDArray

from ballfg.tracks.sightings import Sightings
from ballfg.vision.association.gathering import SeenBall
from ballfg.vision.detection.detections import Candidates, Detections
from ballfg.vision.tracking.contact_sheet import EXPOSURES, MOST_TRACKS, WIDTH, ContactSheet, View
from ballfg.vision.tracking.overlay import (
    CAPTION,
    HELD,
    RING,
    VIEW_WIDTH,
    Image,
    OverlayPainter,
    ViewPainter,
    bgr,
    caption,
    play,
    schedule,
    shown,
    write_overlay,
)
from ballfg.vision.tracking.pipeline import Tracking
from tests.vision.filming import level

SIZE = (640, 360)
RATE = 100.0
FRAMES = 60
START, END = 10, 50
DEPTH = 0.05
"""m, standard deviation along the ray of a single camera."""
BACKGROUND, BALL = (60, 90, 70), (240, 250, 245)


RIG = (level("left", -0.6, 2.0), level("right", 0.6, 2.0))


def centre(times: NDArray[np.float64]) -> NDArray[np.float64]:
    s = times - START / RATE
    return np.column_stack((-0.4 + 2.0 * s, 0.1 * s, 0.1 + 1.5 * s - 4.905 * s**2))


def made(count: int = 1) -> Tracking:
    """One flight, given as `count` balls."""
    stamps = np.arange(FRAMES) / RATE
    times = stamps[START:END]
    points = centre(times)
    nothing = Candidates.none()
    detections = tuple(
        Detections.of_frames(
            model.name,
            [
                (t, Candidates.at(model.project(points[i - START]), 0.2) if START <= i < END else nothing)
                for i, t in enumerate(stamps)
            ],
        )
        for model in RIG
    )
    camera_numbers = np.tile([0, 1], len(times))
    pixels = np.stack([model.project(points) for model in RIG], axis=1).reshape(-1, 2)
    sightings = Sightings(
        ("left", "right"), camera_numbers, np.repeat(times, 2), pixels, np.tile(0.04 * np.eye(2), (len(pixels), 1, 1))
    )
    covariances = np.tile(1e-6 * np.eye(3), (len(times), 1, 1))
    ball = SeenBall(times, points, covariances, sightings, np.full(len(times), 2))
    return Tracking(RIG, detections, (ball,) * count, None)


def filmed(number: int) -> Iterator[tuple[float, Image]]:
    for i in range(FRAMES):
        image = np.full((SIZE[1], SIZE[0], 3), BACKGROUND, np.uint8)
        if START <= i < END:
            u, v = RIG[number].project(centre(np.array([i / RATE])))[0]
            cv2.circle(image, (round(u * 16), round(v * 16)), 5 * 16, BALL, -1, cv2.LINE_AA, 4)
        yield i / RATE, image


# --- which frames stand side by side -------------------------------------------------------------------------------


def test_the_frame_on_show_is_the_nearest_in_true_time() -> None:
    left = Detections.of_frames("left", [(i / RATE, Candidates.none()) for i in range(FRAMES)])
    late = 0.3  # s
    stamps = late + 0.004 + np.arange(0, FRAMES, 2) / RATE
    right = Detections.of_frames("right", [(float(t), Candidates.none()) for t in stamps])
    moments = schedule((left, right), (RIG[0], replace(RIG[1], time_offset=late)))
    assert np.array_equal(moments.times, left.frames)
    assert np.array_equal(moments.frames[:, 0], np.arange(FRAMES))
    apart = np.abs(right.frames[moments.frames[:, 1]] - late - moments.times)
    every = np.abs(right.frames[None] - late - moments.times[:, None]).min(axis=1)
    assert apart == pytest.approx(every)


def test_a_frame_is_held_for_a_while_and_then_gone() -> None:
    clock = np.array([0.0, 0.01, 0.5])
    times = np.array([0.01 + 0.9 * HELD, 0.01 + 1.1 * HELD, 0.5 - 0.9 * HELD])
    assert shown(clock, times).tolist() == [1, -1, 2]
    assert shown(np.array([1.0]), np.array([0.0, 1.0])).tolist() == [-1, 0]
    assert shown(np.zeros(0), times).tolist() == [-1, -1, -1]


def test_what_other_cameras_film_before_and_after_is_shown_too() -> None:
    left = Detections.of_frames("left", [(1.0 + i / RATE, Candidates.none()) for i in range(20)])
    right = Detections.of_frames("right", [(0.9 + i / RATE / 0.9, Candidates.none()) for i in range(15)])
    moments = schedule((left, right), RIG)
    assert moments.times[0] == pytest.approx(0.9)
    assert (np.diff(moments.times) > 0).all()
    assert set(left.frames) <= set(moments.times)
    assert len(moments.times) == 20 + 9


def test_playing_skips_and_repeats_frames_as_the_clock_wants() -> None:
    moments = schedule(made().detections, RIG)
    moments = replace(moments, frames=np.array([[0, -1], [2, 3], [2, 3], [5, -1]]), times=np.arange(4.0))
    numbered = [iter([(0.0, np.full((1, 1, 3), i, np.uint8)) for i in range(9)]) for _ in RIG]
    shown = [[None if image is None else int(image[0, 0, 0]) for image in images] for images in play(moments, numbered)]
    assert shown == [[0, None], [2, 3], [2, 3], [5, None]]


# --- the overlay ---------------------------------------------------------------------------------------------------


def test_the_ball_is_ringed_in_its_colour_in_each_view() -> None:
    tracking = made()
    painter = OverlayPainter(tracking)
    assert painter.size == (2 * VIEW_WIDTH, SIZE[1])
    moments = schedule(tracking.detections, RIG)
    pages = list(painter.paint_all(moments, [filmed(0), filmed(1)]))
    assert len(pages) == FRAMES
    page = pages[30].astype(int)
    for number, model in enumerate(RIG):
        u, v = model.project(centre(np.array([30 / RATE])))[0] + (number * VIEW_WIDTH, 0.0)
        for across, down in ((-RING, 0.0), (0.0, RING)):
            assert np.abs(page[round(v + down), round(u + across)] - bgr(0)).max() < 60
        assert np.abs(page[round(v), round(u)] - BALL).max() < 30  # the ball itself stays in sight
    assert np.abs(pages[5][100:200, :VIEW_WIDTH].astype(int) - BACKGROUND).max() == 0  # before there is a ball


def test_the_video_has_a_frame_for_each_moment(tmp_path: Path) -> None:
    path = tmp_path / "overlay.mp4"
    watched: list[tuple[int, str]] = []

    def watch(items: Iterator[Image], count: int, what: str) -> Iterator[Image]:
        watched.append((count, what))
        return items

    assert write_overlay(path, made(), [filmed(0), filmed(1)], watch) == FRAMES
    video = cv2.VideoCapture(str(path))
    shapes = []
    while (read := video.read())[0]:
        shapes.append(read[1].shape)
    assert shapes == [(SIZE[1], 2 * VIEW_WIDTH, 3)] * FRAMES
    assert watched == [(FRAMES, "overlay frames drawn")]
    with pytest.raises(OSError, match="cannot write this video"):
        write_overlay(tmp_path / "no" / "overlay.mp4", made(), [filmed(0), filmed(1)])


def test_a_view_without_a_frame_says_so() -> None:
    tracking = made()
    painter = OverlayPainter(tracking)
    moments = replace(schedule(tracking.detections, RIG), times=np.zeros(1), frames=np.array([[0, -1]]))
    (page,) = painter.paint_all(moments, [filmed(0), filmed(1)])
    assert page[100:, VIEW_WIDTH : VIEW_WIDTH + 600][: SIZE[1] - 100].max() == 0


# --- the contact sheet ---------------------------------------------------------------------------------------------


def sheet_of(tracking: Tracking, *cameras: int) -> ContactSheet:
    """A sheet that has seen the frames of some cameras."""
    sheet = ContactSheet(tracking, 0.0, (-0.5, 0.5, -0.3, 0.3))
    for number in cameras:
        for _ in sheet.passing(number, filmed(number)):
            pass
    return sheet


def test_a_view_holds_balls_of_several_frames_beside_the_marks() -> None:
    tracking = made()
    frames, pixels = tracking.seen(tracking.balls[0], 0)
    view = View(frames, pixels, SIZE)
    for number, (_, image) in enumerate(filmed(0)):
        view.see(number, image)
    trail = RIG[0].project(tracking.balls[0].points)
    picture = view.picture(pixels, [bgr(0)] * len(pixels), trail)
    assert picture.shape[1:] == (WIDTH, 3)
    assert view.last == END - 1
    white = (picture.astype(int).min(axis=2) > 200).astype(np.uint8)
    assert cv2.connectedComponents(white)[0] - 1 == EXPOSURES
    assert (np.abs(picture.astype(int) - bgr(0)).max(axis=2) < 20).sum() > 50


def test_a_camera_that_never_saw_the_ball_has_a_blank_picture() -> None:
    tracking = made()
    only_left = tracking.balls[0].sightings.select(tracking.balls[0].sightings.camera == 0)
    tracking = replace(tracking, balls=(replace(tracking.balls[0], sightings=only_left),))
    sheet = sheet_of(tracking, 1)
    assert sheet.last(1) == -1
    blank, _ = (np.asarray(panel.images[0].get_array()) for panel in reversed(sheet.flights().axes[:2]))
    assert np.median(blank) == 60


def test_the_sheet_is_the_same_to_the_byte_and_has_a_row_a_track(tmp_path: Path) -> None:
    heights = []
    for count in (1, 2):
        pages = []
        for again in range(2 if count == 1 else 1):
            sheet_of(made(count), 0, 1).write(tmp_path / f"{again}.png")
            pages.append((tmp_path / f"{again}.png").read_bytes())
        assert len(set(pages)) == 1
        heights.append(cv2.imread(str(tmp_path / "0.png")).shape[0])
    assert heights[1] > 1.6 * heights[0]


def test_titles_of_the_sheet_are_alike_and_do_not_run_into_each_other() -> None:
    figure = sheet_of(made(2)).flights()
    figure.draw_without_rendering()
    places = [panel.title.get_window_extent() for panel in figure.axes]
    assert len(places) == 8
    assert len({panel.title.get_fontsize() for panel in figure.axes}) == 1
    for one, other in itertools.combinations(places, 2):
        assert not one.overlaps(other)
    assert all(place.x0 >= 0.0 and place.x1 <= figure.bbox.x1 for place in places)


def test_a_trail_begins_with_its_ball_and_stays_a_moment_after_it() -> None:
    painter, dark = ViewPainter(made(), 0, SIZE[0]), np.full((SIZE[1], SIZE[0], 3), 60, np.uint8)
    before, after, gone = (painter.paint(dark, 55, time)[CAPTION:] for time in (0.05, 0.55, 0.85))
    assert (before == 60).all()
    assert (gone == 60).all()
    u, v = RIG[0].project(centre(np.array([0.4])))[0].round().astype(int)
    assert np.abs(after[v - CAPTION - 2 : v - CAPTION + 3, u].astype(int) - 60).max() > 60


def alone() -> Tracking:
    """The recording as one camera saw it: less sure along the ray than across it."""
    tracking = made()
    ball = tracking.balls[0]
    ray = ball.points - RIG[0].centre
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    wide = 1e-6 * np.eye(3) + DEPTH**2 * ray[:, :, None] * ray[:, None, :]
    seen = replace(ball, covariances=wide, sightings=ball.sightings.select(ball.sightings.camera == 0))
    bounces = {"000": np.array([[0.1, 0.2, 0.02, 0.03, 0.01, 0.001]])}
    return replace(tracking, cameras=RIG[:1], detections=tracking.detections[:1], balls=(seen,), bounces=bounces)


def test_a_single_camera_draws_the_place_below_the_ball_with_its_error() -> None:
    """Ninety percent of places lie within an ellipse of 2.146 standard deviations on the table."""
    tracking, dark = alone(), np.full((SIZE[1], SIZE[0], 3), 60, np.uint8)
    time, table = 0.3, -0.3
    plain, marked = (ViewPainter(tracking, 0, SIZE[0], height).paint(dark, 30, time) for height in (None, table))
    changed = np.argwhere((plain != marked).any(axis=-1))[:, ::-1]
    ball = tracking.balls[0]
    row = int(np.argmin(np.abs(ball.times - time)))
    foot, ray = np.append(ball.points[row, :2], table), ball.points[row] - RIG[0].centre
    along = np.append(ray[:2], 0.0) / np.linalg.norm(ray)
    ends = [RIG[0].project(foot + sign * 2.146 * DEPTH * along) for sign in (-1.0, 1.0)]
    for end in ends:
        assert np.linalg.norm(changed - end, axis=1).min() < 2.0
    assert len(changed) > 20
    middle = RIG[0].project(ball.points[row])
    far = np.linalg.norm(changed - middle, axis=1).max()
    assert far < max(np.linalg.norm(end - middle) for end in ends) + 3.0


def test_the_sheet_tells_bounces_and_draws_the_covariance_of_each_point() -> None:
    tracking = alone()
    _, side, above = sheet_of(tracking, 0).flights().axes
    assert above.get_title() == "from above: bounce at (0.10 ± 0.03, 0.20 ± 0.01) m"
    for panel, up in ((side, 2), (above, 1)):
        (cross,) = [line for line in panel.lines if line.get_marker() == "x"]
        np.testing.assert_array_equal(np.column_stack(cross.get_data()), tracking.bounces["000"][:, [0, up]])
        (ellipses,) = [one for one in panel.collections if isinstance(one, EllipseCollection)]
        variances = np.linalg.eigvalsh(tracking.balls[0].covariances[:, [0, up]][:, :, [0, up]])
        np.testing.assert_allclose(ellipses.get_widths(), 2.0 * np.sqrt(variances[:, 1]), rtol=1e-9)
        np.testing.assert_allclose(ellipses.get_heights(), 2.0 * np.sqrt(variances[:, 0]), rtol=1e-6)


def test_a_candidate_that_is_no_ball_has_a_ring() -> None:
    dark = np.full((SIZE[1], SIZE[0], 3), 60, np.uint8)
    view = ViewPainter(replace(made(), balls=()), 0, SIZE[0]).paint(dark, 30, 0.3)
    view[:CAPTION] = 60  # its text
    changed = np.argwhere((view != 60).any(axis=-1))
    place = RIG[0].project(centre(np.array([0.3])))[0][::-1]
    assert len(changed) > 10
    assert np.linalg.norm(changed - place, axis=1).max() < 8.0


def test_text_can_be_read_on_a_white_picture() -> None:
    view = np.full((100, 300, 3), 255, np.uint8)
    caption(view, "left   frame 3")
    strip = view[:CAPTION]
    assert strip.max() > 220  # the text, on less than half the brightness of the picture
    assert 60 < np.median(strip) < 128
    assert (view[CAPTION:] == 255).all()


def test_of_many_tracks_some_are_shown() -> None:
    figure = ContactSheet(made(5 * MOST_TRACKS), 0.0, None).flights()
    assert len(figure.axes) == 4 * MOST_TRACKS


def test_a_recording_without_a_ball_shows_its_candidates(tmp_path: Path) -> None:
    sheet = sheet_of(replace(made(), balls=()), 1)
    sheet.write(tmp_path / "sheet.png")
    drawn = cv2.imread(str(tmp_path / "sheet.png"))
    assert drawn is not None
    assert (drawn.min(axis=2) > 200)[60:-20, 330:].sum() > 100  # white rings of candidates of score 1
