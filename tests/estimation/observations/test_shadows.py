"""Shadows on the table: the lamp as a camera, its noise, a dataset that holds shadows, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ballfg.benchmarks.cameras.strokes import MODEL, SURFACES, TABLE
from ballfg.estimation import Settings, Smoother, read_sighted, sighted_track
from ballfg.estimation.observations.rig import in_order
from ballfg.estimation.observations.shadows import lamp_camera, with_shadows
from ballfg.estimation.observations.sightings import sightings_of
from ballfg.state import POSITION
from ballfg.tracks.info import Lamp, read_info, write_info
from ballfg.tracks.sightings import Sightings
from tests.commands import status
from tests.diagnosis.one_view.filmed import CAMERA, NOISE, strokes, write_folder
from tests.written_tables import write_sightings

LAMP = Lamp((0.4, 0.7, TABLE + 2.5))
SMOOTHER = Smoother(MODEL, SURFACES, Settings.for_measured(MODEL))


def cast(points: np.ndarray) -> np.ndarray:
    """(n, 3) m, where lines from the lamp through points (n, 3) m meet the table."""
    place = np.array(LAMP.place)
    far = (place[2] - TABLE) / (place[2] - points[:, 2])
    return place + far[:, None] * (points - place)


def shadows_of(seen: Sightings, points: np.ndarray, noise: float = NOISE) -> Sightings:
    """The shadows of a ball at points (n, 3) m as the camera sees them, with noise, px."""
    pixels = CAMERA.project(cast(points)) + noise * np.random.default_rng(2).standard_normal((len(points), 2))
    return replace(seen, pixels=pixels, covariances=np.tile(max(noise, 1e-3) ** 2 * np.eye(2), (len(points), 1, 1)))


def test_a_shadow_is_the_ball_as_the_lamp_sees_it() -> None:
    (track,) = strokes(1, 4)
    seen, points = sightings_of(track).sightings, SMOOTHER.estimate(track).states[:, POSITION]
    both, cameras = with_shadows(seen, shadows_of(seen, points, 0.0), [CAMERA], LAMP, TABLE)
    light = cameras[-1]
    assert both.cameras == (CAMERA.name, "lamp") == tuple(camera.name for camera in cameras)
    rows = both.camera == 1
    assert rows.sum() == len(seen)
    np.testing.assert_allclose(both.times[rows], seen.times, atol=1e-12)
    np.testing.assert_allclose(both.pixels[rows], light.project(points), atol=1e-6)
    np.testing.assert_allclose(light.centre, LAMP.place, atol=1e-12)
    again = light.project(cast(points))
    np.testing.assert_allclose(again, light.project(points), atol=1e-6)


def test_of_two_cameras_that_see_one_shadow_the_surer_counts() -> None:
    (track,) = strokes(1, 4)
    seen, points = sightings_of(track).sightings, SMOOTHER.estimate(track).states[:, POSITION]
    once, other = shadows_of(seen, points), replace(CAMERA, name="other", time_offset=0.5)
    twice = Sightings(
        (CAMERA.name, "other"),
        np.repeat([0, 1], len(once)),
        np.append(once.times, once.times + 0.5),
        np.tile(once.pixels, (2, 1)),
        np.concatenate((once.covariances, 0.25 * once.covariances)),
    )
    both, cameras = with_shadows(seen, twice, [CAMERA, other], LAMP, TABLE)
    surer, _ = with_shadows(seen, replace(once, covariances=0.25 * once.covariances), [CAMERA], LAMP, TABLE)
    assert len(cameras) == 3
    np.testing.assert_allclose(both.covariances, surer.covariances)
    np.testing.assert_allclose(both.times, surer.times, atol=1e-12)


def test_the_noise_of_a_shadow_is_that_of_its_pixel() -> None:
    """Against many draws."""
    (track,) = strokes(1, 4)
    seen, points = sightings_of(track).sightings, SMOOTHER.estimate(track).states[:, POSITION]
    row, rng = len(seen) // 2, np.random.default_rng(5)
    exact = CAMERA.project(cast(points))[row]
    pixels, spread = exact + NOISE * rng.standard_normal((4000, 2)), np.tile(NOISE**2 * np.eye(2), (4000, 1, 1))
    many = Sightings((CAMERA.name,), np.zeros(4000, dtype=np.int64), np.arange(4000.0), pixels, spread)
    both, _ = with_shadows(seen, many, [CAMERA], LAMP, TABLE)
    drawn = both.select(both.camera == 1)
    np.testing.assert_allclose(np.cov(drawn.pixels.T), drawn.covariances.mean(axis=0), rtol=0.1, atol=0.02)


def test_a_dataset_with_shadows_knows_the_depth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Errors, against the truth without noise, shrink; intervals hold; a lamp that is roughly known widens them."""
    tracks, exact = strokes(6, 8), strokes(6, 8, noise=0.03)
    truth = {one.name: SMOOTHER.estimate(one) for one in exact}
    folder = write_folder(tmp_path / "data", tracks)
    seen = {one.name: sightings_of(one).sightings for one in tracks}
    cast_by = {name: shadows_of(rows, truth[name].states[:, POSITION]) for name, rows in seen.items()}
    write_sightings(folder / "shadows.csv", list(cast_by.items()))
    info = read_info(folder / "dataset.yaml")[0]
    assert status("estimate", folder, "--from", "detections", "--out", tmp_path / "no.csv") == 2
    assert "lamp is required beside shadows.csv" in capsys.readouterr().err
    write_info(folder / "dataset.yaml", replace(info, lamp=replace(LAMP, place=(0.0, 0.0, TABLE))))
    assert status("estimate", folder, "--from", "detections", "--out", tmp_path / "no.csv") == 2
    assert "shadows.csv, trajectory '000': lamp.place must be 0.1 m or more above" in capsys.readouterr().err
    write_info(folder / "dataset.yaml", replace(info, lamp=LAMP, table_height=None, table_extent=None))
    assert status("estimate", folder, "--from", "detections", "--out", tmp_path / "no.csv") == 2
    assert "frame.table_height must be a number beside shadows.csv" in capsys.readouterr().err
    write_info(folder / "dataset.yaml", replace(info, lamp=LAMP))
    write_sightings(folder / "shadows.csv", [*cast_by.items(), ("elsewhere", next(iter(cast_by.values())))])
    assert any("shadows of elsewhere left out" in note for note in read_sighted(folder).notes)
    write_sightings(folder / "shadows.csv", list(cast_by.items()))
    errors, inside, widths = list[float](), list[np.ndarray](), list[float]()
    for sigma in (0.0, 0.1):
        lamp = replace(LAMP, sigma=sigma)
        write_info(folder / "dataset.yaml", replace(info, lamp=lamp))
        assert read_info(folder / "dataset.yaml")[0].lamp == lamp
        data = read_sighted(folder)
        assert data.notes == []
        assert not data.one_view
        found = [SMOOTHER.estimate(one) for one in data]
        widths.append(float(np.mean([one.sigmas[:, POSITION].mean() for one in found])))
        if sigma == 0.0:
            for one in found:
                off = one.states[:, POSITION] - truth[one.name].states[:, POSITION]
                errors.append(float(np.sqrt((off**2).sum(axis=1).mean())))
                inside.append(np.abs(off) < 1.645 * one.sigmas[:, POSITION])
    plain = [SMOOTHER.estimate(one) for one in tracks]
    without = [
        float(np.sqrt(((one.states - truth[one.name].states)[:, POSITION] ** 2).sum(axis=1).mean())) for one in plain
    ]
    assert np.median(errors) < 0.5 * np.median(without)
    assert np.concatenate(inside).mean() > 0.8
    assert widths[1] > 1.2 * widths[0]


def test_what_cannot_be_is_refused() -> None:
    seen = sightings_of(strokes(1, 4)[0]).sightings
    with pytest.raises(
        ValueError, match=r"lamp.place must be 0.1 m or more above the table at z = 0.76 m; got z = 0.8"
    ):
        lamp_camera("lamp", Lamp((0.0, 0.0, 0.8)), 0.76)
    above = replace(seen, pixels=np.tile([640.0, -4000.0], (len(seen), 1)))
    with pytest.raises(ValueError, match=r"a shadow must lie on the table; the one at t = .* lies above the horizon"):
        with_shadows(seen, above, [CAMERA], LAMP, TABLE)
    with pytest.raises(TypeError, match=r"lamp.place must be three numbers in m"):
        Lamp((0.0, 1.0))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"lamp.sigma must be at least 0"):
        Lamp((0.0, 0.0, 2.0), -0.1)
    with pytest.raises(ValueError, match=r"lamp.place must be finite"):
        Lamp((0.0, float("nan"), 2.0))
    assert sighted_track("a", in_order(seen, [CAMERA]), [CAMERA], model=MODEL, surfaces=SURFACES).one_view
