"""Calibration on the strokes of one camera: a planted drag, the volume of states against a dense route, refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ballfg.dynamics import load_model, nominal_model
from ballfg.estimation import Smoother, dataset_settings, dataset_surfaces, read_sighted
from ballfg.estimation.observations.sightings import sighted_track, sightings_of
from ballfg.factors.batch import COEFFICIENTS
from ballfg.factors.linear.step import weighted
from ballfg.learning.calibration import run
from ballfg.learning.calibration.calibrate import calibrate
from ballfg.learning.calibration.coefficients import with_values
from ballfg.learning.calibration.problem import pose
from ballfg.learning.calibration.volume import estimate_with_slopes
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.progress import unwatched
from ballfg.tracks.info import TABLE_TENNIS, DatasetInfo, write_info
from ballfg.vision.camera_file import write_cameras
from tests.estimation.observations.sighted_rig import TABLE, world
from tests.estimation.observations.test_one_view import SIDE, pixels_of, stroke
from tests.written_tables import write_sightings

DRAG, PLANTED, STROKES = "flight.drag.k", 0.16, 16
EXTENT = (-1.37, 1.37, -0.76, 0.76)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Strokes of a ball with more drag than the nominal one, from the side."""
    path = tmp_path_factory.mktemp("strokes") / "data"
    path.mkdir()
    ball = world()._replace(model=with_values(nominal_model(), [DRAG], np.array([PLANTED])))
    write_info(path / "dataset.yaml", DatasetInfo("strokes", TABLE, TABLE_TENNIS, table_extent=EXTENT))
    write_cameras(path / "cameras.yaml", [SIDE])
    made = {f"{seed:03d}": stroke(ball, seed) for seed in range(STROKES)}
    seen = {name: pixels_of(states[:, :3], times, SIDE, 1.0, int(name)) for name, (times, states) in made.items()}
    write_sightings(path / "detections.csv", seen.items())
    return path


def test_a_planted_drag_comes_back(folder: Path, tmp_path: Path) -> None:
    """By the command's own code, from detections alone; the model file states the drag and how sure it is."""
    config = CalibrationConfig(data=str(folder), source="detections", jobs=1)
    run.run_calibration(config, tmp_path / "out", resume=False, jobs=1, watch=unwatched)
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert list(report["coefficients"]) == [DRAG]
    found = report["coefficients"][DRAG]
    assert abs(found["after"] - PLANTED) < 2.5 * found["sigma"]
    assert found["sigma"] < 0.7 * found["prior_sigma"]
    assert found["spread"] == 0.0
    model = load_model(tmp_path / "out" / "model.yaml")
    assert model.noise is not None
    assert model.noise.coefficients == {DRAG: found["next_track_sigma"]}
    settings = dataset_settings(read_sighted(folder), model)
    assert settings.coefficients[DRAG] == found["next_track_sigma"]


def test_slopes_of_the_volume_are_those_of_dense_matrices(folder: Path) -> None:
    """log det R of the states alone, by dense triangles at minima of problems with other fixed drags."""
    data, model = read_sighted(folder), nominal_model()
    settings = dataset_settings(data, model)
    fixed, far = replace(settings, coefficients={**settings.coefficients, DRAG: 1e-7}), 0.01
    smoother = Smoother(model, dataset_surfaces(data), settings)
    for track in list(data)[1:4]:
        estimate, (slope,) = estimate_with_slopes(smoother, [DRAG], track)
        middle = float(estimate.coefficients[estimate.coefficient_names.index(DRAG)])
        logs = []
        for drag in (middle - far, middle + far):
            other = Smoother(with_values(model, [DRAG], np.array([drag])), dataset_surfaces(data), fixed)
            _, solution = other.solved(track.since_first())
            logs.append(log_determinant(solution, list(fixed.coefficients).index(DRAG)))
        assert slope == pytest.approx((logs[1] - logs[0]) / (2.0 * far), rel=0.3)
        assert slope < -2.0  # so that without it a pooled drag is too small


def log_determinant(solution, fixed: int) -> float:  # type: ignore[no-untyped-def]
    """log det R of all states and coefficients but a fixed one."""
    values = solution.minimum.values
    n, p = values.states.shape[0], len(values.coefficients)
    rows = []
    for batch in solution.graph.linearize(values):
        _, jacobians = weighted(batch)
        for k, variables in enumerate(batch.variables):
            row = np.zeros((jacobians[0].shape[1], 9 * n + p))
            for variable, jacobian in zip(variables, jacobians, strict=True):
                start = 9 * n if variable == COEFFICIENTS else 9 * variable
                row[:, start : start + jacobian.shape[-1]] += jacobian[k]
            rows.append(row)
    stacked = np.delete(np.concatenate(rows), 9 * n + fixed, axis=1)
    return float(np.log(np.abs(np.diag(np.linalg.qr(stacked, mode="r")))).sum())


def test_errors_of_an_exact_path_across_its_rays_are_the_noise() -> None:
    """Moved by a centimetre across the rays, the errors grow by as much; moved along them, not at all."""
    times, states = stroke(world(), 3)
    exact = sighted_track("a", pixels_of(states[:, :3], times, SIDE, 1e-2), [SIDE])
    rays = states[:, :3] - SIDE.centre
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    aside = np.cross(rays, [0.0, 0.0, 1.0])
    aside /= np.linalg.norm(aside, axis=1)[:, None]
    seen, none = sightings_of(exact), np.zeros((len(times) - 4, 3, 3))
    for move, size in ((0.0 * rays, 0.0), (0.01 * rays, 0.0), (0.01 * aside, 0.01)):
        errors, sigmas = seen.across(4, (states[:, :3] + move)[4:], none)
        np.testing.assert_allclose(np.linalg.norm(errors, axis=1), size, atol=4e-4)
    depth = np.linalg.norm(states[4:, :3] - SIDE.centre, axis=1)
    np.testing.assert_allclose(sigmas, np.repeat(1e-2 * depth[:, None] / 1000.0, 2, axis=1), rtol=0.1)


@pytest.mark.parametrize("fields", [{"groups": "group"}, {"kind": "auto"}])
def test_spins_of_one_view_are_refused(folder: Path, fields: dict[str, str]) -> None:
    with pytest.raises(ValueError, match="one camera's spins hold errors of its depth"):
        pose(read_sighted(folder), nominal_model(), CalibrationConfig(**fields))  # type: ignore[arg-type]


def test_cut_anywhere_the_same_numbers(folder: Path) -> None:
    problem = pose(read_sighted(folder), nominal_model(), CalibrationConfig(max_iterations=2, tolerance=1e-12))
    steps = list(calibrate(problem))
    assert list(calibrate(problem, steps[:2])) == steps[2:]
