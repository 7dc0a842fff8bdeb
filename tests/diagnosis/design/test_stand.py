"""Where a camera should stand: stated errors against those of noisy strokes, places that are bad, and refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from ballfg.benchmarks.cameras.strokes import MODEL, SURFACES, TABLE, Scattered, drawn_ball, scattered
from ballfg.diagnosis.design.stand import _hidden, where_to_stand
from ballfg.estimation import Settings, Smoother, sighted_track
from ballfg.simulation.cameras import looking_at
from ballfg.state import POSITION
from ballfg.tracks import Dataset, Track, read_dataset, write_dataset
from ballfg.tracks.info import TABLE_TENNIS, DatasetInfo
from ballfg.tracks.sightings import Sightings
from ballfg.vision import Camera
from ballfg.vision.camera_file import write_cameras
from tests.commands import status

RATE, NOISE, COUNT = 50.0, 1.0, 8  # Hz, px
HIGH: Final = (-0.5, -4.0, TABLE + 1.5)
LENS: Final = looking_at("phone", HIGH, (0.0, 0.0, TABLE), 1100.0, (1280, 720))


def drawn() -> list[Scattered]:
    """Strokes of the population, to either side."""
    rng, found = np.random.default_rng(3), list[Scattered]()
    while len(found) < COUNT:
        side = float(rng.choice([-1, 1]))
        place = np.array([side * rng.uniform(1.2, 1.5), rng.uniform(-0.4, 0.4), TABLE + rng.uniform(0.1, 0.35)])
        one = scattered(0.0, place, -side, drawn_ball(rng), rng)
        found += [] if one is None else [one]
    return found


def path_of(stroke: Scattered) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) s and positions (n, 3) m."""
    times = np.arange(0.004, stroke.end, 1.0 / RATE)
    return times, np.array([stroke.at(float(t))[POSITION] for t in times])


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder, rng, tracks = tmp_path_factory.mktemp("stand") / "strokes", np.random.default_rng(4), list[Track]()
    for number, stroke in enumerate(drawn()):
        times, positions = path_of(stroke)
        measured = positions + 2e-3 * rng.standard_normal(positions.shape)
        tracks.append(Track(times, measured, np.full_like(measured, 2e-3), name=f"{number:03d}"))
    info = DatasetInfo("strokes", TABLE, TABLE_TENNIS, rate=RATE, table_extent=SURFACES.extent)
    folder.mkdir()
    write_dataset(folder, info, tracks)
    return read_dataset(folder)


def test_errors_are_those_that_noisy_strokes_have(data: Dataset) -> None:
    (stand,) = where_to_stand(data, MODEL, LENS, np.array([HIGH]), noise=NOISE)
    assert (stand.place, stand.seen, stand.uncertain) == (HIGH, 1.0, 0.0)
    middle = np.median(np.concatenate([path_of(stroke)[1] for stroke in drawn()]), axis=0)
    camera = looking_at("phone", HIGH, middle, 1100.0, (1280, 720))
    smoother, rng, errors = Smoother(MODEL, SURFACES, Settings.for_measured(MODEL)), np.random.default_rng(5), []
    for stroke in drawn():
        times, positions = path_of(stroke)
        pixels = camera.project(positions) + NOISE * rng.standard_normal((len(times), 2))
        own = np.zeros(len(times), dtype=np.int64), times, pixels, np.tile(NOISE**2 * np.eye(2), (len(times), 1, 1))
        seen = sighted_track("a", Sightings(("phone",), *own), [camera], model=MODEL, surfaces=SURFACES)
        errors.append(np.sqrt(((smoother.estimate(seen).states[:, POSITION] - positions) ** 2).sum(axis=1).mean()))
    assert 0.5 < np.median(errors) / stand.sigma < 1.7


def test_a_camera_should_stand_high_and_see_the_strokes(data: Dataset) -> None:
    low = (-0.5, -4.0, TABLE + 0.15)
    found = where_to_stand(data, MODEL, LENS, np.array([low, HIGH]), noise=NOISE)
    assert [stand.place for stand in found] == [HIGH, low]
    assert found[1].sigma > 1.5 * found[0].sigma
    long = looking_at("long", HIGH, (0.0, 0.0, TABLE), 40_000.0, (1280, 720))
    (stand,) = where_to_stand(data, MODEL, long, np.array([HIGH]))
    assert (stand.sigma, stand.seen, stand.uncertain) == (np.inf, 0.0, 0.0)


def test_a_picture_of_a_part_of_the_strokes_is_not_the_best_one(data: Dataset) -> None:
    """A part of a picture holds fewer sightings of the same noise: it tells no more of the strokes than all of it."""
    near, found = np.array((0.0, -1.2, TABLE + 1.2)), []
    middle = np.median(np.concatenate([path_of(stroke)[1] for stroke in drawn()]), axis=0)
    for size in ((4000, 4000), (1280, 720)):
        camera = looking_at("phone", near, middle, 1100.0, size)
        (stand,) = where_to_stand(data, MODEL, camera, near[None], noise=NOISE)
        pixels = camera.project(np.concatenate([path_of(stroke)[1] for stroke in drawn()]))
        share = ((pixels > 0) & (pixels < np.array(size) - 1)).all(axis=1).mean()
        assert abs(stand.seen - share) < 0.02
        found.append(stand)
    assert found[0].seen == 1.0
    assert found[1].seen < 0.7
    assert found[1].sigma > found[0].sigma


def test_the_table_hides_strokes_from_a_camera_below_it(data: Dataset) -> None:
    """From 2 m beside the table and 0.6 m below it a ball over its middle is hidden up to 0.37 m above it."""
    lens = looking_at("phone", HIGH, (0.0, 0.0, TABLE), 700.0, (1280, 720))
    below, beside = (0.0, -2.0, TABLE - 0.6), (0.0, -2.0, TABLE + 0.6)
    found = where_to_stand(data, MODEL, lens, np.array([below, beside]), noise=NOISE)
    assert [stand.place for stand in found] == [beside, below]
    points = np.concatenate([path_of(stroke)[1] for stroke in drawn()])
    up, edges = (points[:, 2] - TABLE) / 0.6, np.array(SURFACES.extent)
    x, y = points[:, 0] / (1 + up), (points[:, 1] - 2.0 * up) / (1 + up)  # where the rays pass the table's height
    hidden = (x > edges[0]) & (x < edges[1]) & (y > edges[2]) & (y < edges[3]) & (up > 0)
    assert hidden.mean() > 0.3
    assert abs(found[1].seen - (~hidden).mean()) < 0.05
    assert found[0].seen > 0.95
    camera = looking_at("phone", below, (0.0, 0.0, TABLE), 700.0, (1280, 720))
    assert _hidden(camera, points, SURFACES).mean() == pytest.approx(hidden.mean())
    assert not _hidden(camera, points, replace(SURFACES, extent=None)).any()  # a table whose ends nobody knows


def test_places_that_are_none_are_refused(data: Dataset) -> None:
    for places in (np.zeros(3), np.zeros((0, 3))):
        with pytest.raises(ValueError, match="places must have shape"):
            where_to_stand(data, MODEL, LENS, places)
    with pytest.raises(ValueError, match="noise must be positive; got 0 px"):
        where_to_stand(data, MODEL, LENS, np.array([HIGH]), noise=0.0)


def lens_file(folder: Path, *cameras: Camera) -> Path:
    write_cameras(folder / "lens.yaml", cameras, posed=False)
    return folder / "lens.yaml"


def test_the_command_prints_and_writes_places(
    data: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("design", data.path, "--cameras", lens_file(tmp_path, LENS), "--jobs", 1)
    assert status(*words, "--stand", "z=1.0..2.0,x=0,y=-4", "--out", tmp_path / "places.csv") == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("phone at 2 places, best first")
    assert said[1].split()[:3] == ["x=0", "y=-4", "z=2"]
    assert (tmp_path / "places.csv").read_text().splitlines()[0] == "x,y,z,sigma,seen,uncertain"
    for bad, message in (
        (("--stand", "x=0,y=-4"), "--stand must name x, y and z; got x, y. Write x=-4..4:2"),
        (("--stand", "x=0,y=-4,z"), "--stand must read NAME=LEVEL"),
        (("--stand", "x=0,y=-4,z=2", "--candidates", "speed=8"), "--candidates is for shots, --stand for a camera."),
        (("--stand", "x=0,y=-4,z=2", "--shots", "10"), "--shots is for shots, --stand for a camera."),
        (("--stand", "x=0,y=-4,z=2", "--seed", "0"), "--seed is for shots, --stand for a camera."),
        ((), "--candidates or --stand must be given; got neither."),
        (("--candidates", "speed=8"), "--cameras is for --stand. Leave it out."),
        (("--stand", "x=0,y=-4,z=2", "--noise", "0"), "noise must be positive; got 0 px."),
    ):
        assert status(*words, *bad) == 2
        assert message in capsys.readouterr().err
    assert status("design", data.path, "--stand", "x=0,y=-4,z=2") == 2
    assert "--stand needs --cameras" in capsys.readouterr().err
    two = lens_file(tmp_path, LENS, looking_at("other", HIGH, (0.0, 0.0, TABLE), 900.0, (1280, 720)))
    assert status("design", data.path, "--stand", "x=0,y=-4,z=2", "--cameras", two) == 2
    assert "must hold one camera for --stand; it holds 2" in capsys.readouterr().err
