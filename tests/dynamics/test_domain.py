"""The range of speeds, spins and places that a model was fitted on: of tracks, in files, and outside of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ballfg.dynamics import load_model, nominal_model, save_model
from ballfg.dynamics.domain import Domain
from ballfg.prediction.c_header import c_header
from ballfg.tracks import Track


def _moving(speed: float, spin: float | None = None) -> Track:
    """A track along x, with turning direction, so that its chords are shorter than its path by less than 1 %."""
    times = np.arange(0.0, 1.0, 0.01)
    labels = {} if spin is None else {"spin_x": spin, "spin_y": 0.0, "spin_z": 0.0}
    return Track(times, np.stack((speed * times, 0.1 * times, np.ones_like(times)), axis=1), None, labels, name="a")


def test_ranges_are_those_of_the_tracks() -> None:
    found = Domain.of([_moving(2.0, 100.0), _moving(6.0, 300.0)])
    assert found is not None
    assert found.ranges["speed"] == pytest.approx((2.0025, 6.0008), abs=1e-3)
    assert found.ranges["spin"] == (100.0, 300.0)
    assert found.ranges["x"] == pytest.approx((0.0, 5.94), abs=0.08)
    assert Domain.of([]) is None


def test_what_lies_outside_is_said_with_its_share_and_quantity() -> None:
    fitted = Domain({"speed": (2.0, 4.0), "x": (0.0, 10.0)})
    assert fitted.doubts([_moving(3.0), _moving(4.1)], "m.yaml") == []  # within a tenth of the width
    (said,) = fitted.doubts([_moving(3.0), _moving(5.0)], "m.yaml")
    assert said.startswith("50 % of the samples lie outside of what m.yaml was fitted on")
    assert "speed 2 to 4 m/s" in said
    assert "x " not in said.partition("(")[2]


def test_a_model_file_keeps_it(tmp_path: Path) -> None:
    model = nominal_model()
    model.domain = Domain({"speed": (1.5, 9.0), "z": (0.0, 2.0)})
    save_model(model, tmp_path / "model.yaml")
    assert load_model(tmp_path / "model.yaml").domain == model.domain
    text = (tmp_path / "model.yaml").read_text()
    (tmp_path / "model.yaml").write_text(text.replace("- 1.5", "- 15"))
    with pytest.raises(ValueError, match="pairs of growing numbers"):
        load_model(tmp_path / "model.yaml")


def test_a_file_knows_the_ball_that_its_model_was_fitted_on(tmp_path: Path) -> None:
    """Where nobody states the ball, as for a header in C; a ball of another size is a doubt."""
    model = nominal_model("tennis")
    model.domain = Domain.of([_moving(2.0)], [0.033, 0.034])
    save_model(model, path := tmp_path / "model.yaml")
    assert load_model(path).radius == 0.033  # the nearest to a ball that nobody states
    assert "{0.0, -INFINITY, 0.033," in c_header(load_model(path), "ball")
    assert (load_model(path, radius=0.0335).radius, load_model(path, radius=0.0335).learned_from) == (0.0335, None)
    assert (load_model(path, radius=0.02).radius, load_model(path, radius=0.02).learned_from) == (0.02, 0.033)
    assert load_model(path, radius=0.037).learned_from is None  # as near as balls of one kind are
    save_model(load_model(path, radius=0.02), path)
    assert load_model(path).radius == 0.033
    assert Domain.of([], [0.02]) is None


@pytest.mark.parametrize("ranges", [{"colour": (0.0, 1.0)}, {"speed": (1.0,)}, {"speed": 3.0}, {"speed": (2.0, 1.0)}])
def test_damaged_sections_are_refused(ranges: dict[str, tuple[float, float]]) -> None:
    with pytest.raises(ValueError, match=r"domain: \{speed"):
        Domain(ranges)


def test_a_doubt_names_quantities_that_few_samples_each_are_beyond() -> None:
    """4 % of the samples are too far along x, other 4 % along z: 8 % lie outside."""
    positions = np.full((50, 3), 0.5)
    positions[:2, 0] = positions[2:4, 2] = 3.0
    fitted = Domain({axis: (0.0, 1.0) for axis in "xyz"})
    (doubt,) = fitted.doubts([Track(0.01 * np.arange(50), positions)], "m.yaml")
    assert doubt == "8 % of the samples lie outside of what m.yaml was fitted on (x 0 to 1 m, z 0 to 1 m)"
