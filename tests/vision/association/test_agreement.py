"""The check of cameras against each other: the one that was nudged is named, and its nudge measured."""

from dataclasses import replace

import numpy as np
import pytest

from ballfg.vision.association.agreement import CameraAgreement, _culprit, _may_have_moved, check_agreement
from ballfg.vision.association.associate import associate
from ballfg.vision.camera import Camera
from tests.vision.filming import World, film, rig, shots, turned

CAMERAS = rig()
WORLD = World(shots(3, np.random.default_rng(1)), 3.2)
FILMS = film(CAMERAS, WORLD)


def nudged(number: int, degrees: float, axis: tuple[float, float, float]) -> list[Camera]:
    cameras = list(CAMERAS)
    cameras[number] = turned(cameras[number], degrees, axis)
    return cameras


@pytest.mark.parametrize(
    ("number", "axis"),
    [
        pytest.param(number, axis, marks=[pytest.mark.thorough] * (axis[number] != 1.0))
        for number in range(3)
        for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    ],
)
def test_names_a_camera_turned_by_half_a_degree(number: int, axis: tuple[float, float, float]) -> None:
    cameras = nudged(number, 0.5, axis)
    found = check_agreement(associate(FILMS, cameras), cameras)
    name = CAMERAS[number].name
    assert found.culprit == name
    assert list(found.by_camera) == ["left", "right", "far"]
    mine = found.by_camera[name]
    assert mine.rotation == pytest.approx(0.5, abs=0.1)
    assert mine.shift < 0.01
    assert mine.corrected < 0.4
    if axis[2] == 0.0:
        assert mine.residual == pytest.approx(8.7, abs=0.6)  # 0.5 degrees at 1000 px
        assert f"Camera {name} has moved" in found.sentence


def test_good_cameras_agree() -> None:
    found = check_agreement(associate(FILMS, CAMERAS), CAMERAS)
    assert found.culprit is None
    assert found.misfit == pytest.approx(1.0, abs=0.3)
    assert found.sentence.startswith("The cameras agree")


def test_two_wrong_cameras_are_not_blamed_on_one() -> None:
    cameras = nudged(0, 0.5, (1.0, 0.0, 0.0))
    cameras[1] = turned(cameras[1], 0.5, (0.0, 1.0, 0.0))
    found = check_agreement(associate(FILMS, cameras), cameras)
    assert found.culprit is None
    assert "no single one explains it" in found.sentence


@pytest.mark.parametrize(("seed", "number", "late"), [(1, 0, -0.1), (3, 2, 0.15)])
def test_a_wrong_clock_is_no_move(seed: int, number: int, late: float) -> None:
    """No turn by tens of degrees is reported, and points that run away under such a turn end nothing."""
    films = film(CAMERAS, World(shots(3, np.random.default_rng(seed)), 3.2, seed=seed))
    films[number] = replace(films[number], frames=films[number].frames + late)
    balls = associate(films, CAMERAS)
    found = check_agreement(balls, CAMERAS)
    assert found.culprit is None
    assert found.misfit > 100.0
    name = CAMERAS[number].name
    assert found.by_camera[name].residual > 20.0
    assert found.sentence.startswith(f"Camera {name} does not fit the others: it is off by ")
    assert found.sentence.endswith("Check its clock (time_offset), its name and its pose.")


@pytest.mark.parametrize(
    ("rotation", "shift", "share", "moved"),
    [
        (0.5, 0.01, 1.0, True),
        (8.0, 0.2, 0.3, True),
        (13.0, 0.0, 1.0, False),
        (0.5, 0.7, 1.0, False),
        (0.5, 0.0, 0.2, False),
    ],
)
def test_a_move_is_small_and_of_a_camera_that_saw_the_balls(
    rotation: float, shift: float, share: float, moved: bool
) -> None:
    assert _may_have_moved(CameraAgreement(5.0, 0.95, rotation, shift, 1.0), share) is moved


@pytest.mark.parametrize(("explained", "culprit"), [(0.78, None), (0.82, "left"), (0.95, "left")])
def test_a_culprit_explains_four_fifths(explained: float, culprit: str | None) -> None:
    """One that leaves a fifth of the disagreement may be wrong beside another camera, however clearly it leads."""
    shares = {"left": explained, "right": 0.01, "far": 0.02}
    by_camera = {name: CameraAgreement(5.0, share, 0.5, 0.0, 1.0) for name, share in shares.items()}
    assert _culprit(by_camera, 30.0) == culprit


def test_two_cameras_cannot_say() -> None:
    cameras = CAMERAS[:2]
    found = check_agreement(associate(FILMS[:2], cameras), cameras)
    assert found.culprit is None
    assert found.by_camera == {}
    assert "not known" in found.sentence


def test_no_balls() -> None:
    assert "0 points" in check_agreement([], CAMERAS).sentence
