"""What a page shows of a ball that one camera saw: points on its rays, the covariance along them, and the camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import PolyCollection

from ballfg.estimation import read_sighted
from ballfg.pages.given import recognise
from ballfg.pages.pictures import views
from ballfg.pages.show_page import show_page
from ballfg.pages.shown import Shown, collect
from ballfg.state import CORRELATIONS, SIGMA_NAMES, STATE_NAMES
from ballfg.vision.camera import Camera
from ballfg.vision.camera_file import write_cameras
from tests.estimation.observations.sighted_rig import looking
from tests.pages.made import EXTENT, RADIUS, TABLE, Fall, make, write

FALL = Fall(speed=(3.0, -0.4))
NOISE, DEPTH = 0.5, 0.1
"""px; m, standard deviation along a ray."""
CAMERA = looking("oblique", (-1.6, -2.8, 2.0))
LEVEL_90 = 1.6448536


def spread(places: np.ndarray) -> np.ndarray:
    """(n, 3, 3) m^2: `DEPTH` along the ray to each place, a centimetre across it."""
    ray = places - CAMERA.centre
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return 1e-4 * np.eye(3) + (DEPTH**2 - 1e-4) * ray[:, :, None] * ray[:, None, :]


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Shown:
    folder = tmp_path_factory.mktemp("one_view")
    truth, rng = FALL.states(), np.random.default_rng(2)
    (folder / "dataset.yaml").write_text(
        f"name: one view\nframe:\n  up: z\n  table_height: {TABLE}\n{EXTENT}ball: {{radius: {RADIUS}, mass: 0.0027}}\n"
    )
    write_cameras(folder / "cameras.yaml", [CAMERA])
    pixels = CAMERA.project(truth[:, :3]) + NOISE * rng.normal(size=(len(truth), 2))
    head = ("trajectory", "t", "camera", "u", "v", "sigma_u", "sigma_v", "rho_uv", "score")
    seen = [["a", t, "oblique", *p, NOISE, NOISE, 0.0, 1.0] for t, p in zip(FALL.times, pixels, strict=True)]
    write(folder / "detections.csv", head, seen)
    covariances = spread(truth[:, :3])
    sigmas = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    rho = [covariances[:, i, j] / (sigmas[:, i] * sigmas[:, j]) for i, j in CORRELATIONS.values()]
    rows = np.column_stack((FALL.times, truth, sigmas, np.full((len(truth), 6), 0.1), *rho))
    head = ("trajectory", "t", *STATE_NAMES, *SIGMA_NAMES, *CORRELATIONS)
    write(folder / "states.csv", head, [["a", *row] for row in rows.tolist()])
    return collect(recognise([folder, folder / "states.csv"], read_sighted))


def test_a_sample_is_the_point_of_its_ray_that_is_nearest_to_the_estimate(shown: Shown) -> None:
    (shot,) = shown.shots
    assert shot.sight is not None
    np.testing.assert_allclose(CAMERA.project(shot.positions), np.stack(pixels_of(CAMERA, shown)), atol=1e-6)
    rays = shot.positions - CAMERA.centre
    np.testing.assert_allclose((shot.residuals() * rays).sum(axis=1), 0.0, atol=1e-9)  # across the ray
    whitened = shot.residuals() / shot.noise
    assert np.isfinite(shot.noise).all()
    assert np.sqrt((whitened**2).mean()) == pytest.approx(1.0, abs=0.15)  # of 120 numbers
    assert "One camera saw the ball" in shown.noise


def pixels_of(camera: Camera, shown: Shown) -> list[np.ndarray]:
    """The sightings of the only shot in a camera."""
    (track,) = iter(shown.given.dataset or ())
    (seen,) = track.observations
    return [pixel for pixel, number in zip(seen.sightings.pixels, seen.sightings.camera, strict=True) if number == 0]


def test_a_band_has_the_width_of_the_covariance_across_the_path(shown: Shown) -> None:
    (shot,) = shown.shots
    (band,) = [one for one in views(shot).axes[1].collections if isinstance(one, PolyCollection)]
    corners = np.array([path.vertices[:4] for path in band.get_paths()])
    across = corners[:, 0] - corners[:, 3]
    width = np.linalg.norm(across, axis=1)
    along = across / width[:, None]
    wanted = np.einsum("ni,nij,nj->n", along, spread(shot.states[:-1, :3])[:, :2, :2], along)
    np.testing.assert_allclose(width, 2.0 * LEVEL_90 * np.sqrt(wanted), rtol=1e-6)


def test_the_page_holds_the_camera_its_rays_and_correlations(shown: Shown) -> None:
    page = show_page(shown)
    assert '<select id="cameras"><option>shown</option><option>hidden</option>' in page
    assert '"cameras":[{"name":"oblique"' in page.replace(" ", "")
    assert '"correlations":[[' in page.replace(" ", "")
    assert shown.shots[0].sight is not None
    ((centres, ends),) = shown.shots[0].sight.some(shown.shots[0].positions).values()
    np.testing.assert_allclose(centres, np.tile(CAMERA.centre, (len(centres), 1)))
    assert len(ends) == 14
    np.testing.assert_allclose(ends[[0, -1]], shown.shots[0].positions[[0, -1]], atol=1e-12)


def test_measured_positions_have_no_camera(tmp_path: Path) -> None:
    made = make(tmp_path, {"a": Fall()})
    page = show_page(collect(recognise([made.dataset, made.states])))
    assert 'id="cameras"' not in page
    assert '"correlations":[]' in page.replace(" ", "")
