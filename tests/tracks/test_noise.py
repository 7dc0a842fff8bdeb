"""The noise that a file states: round trips, limits, messages."""

import pytest

from ballfg.dynamics import load_model, nominal_model, save_model
from ballfg.tracks import TABLE_TENNIS
from ballfg.tracks.info import DatasetInfo, read_info, write_info
from ballfg.tracks.noise import TrackNoise

NOISE = TrackNoise(
    position=(0.001, 0.002, 0.0015),
    memory=(0.0, 0.003, 0.001),
    memory_time=0.02,
    stamp_jitter=0.0004,
    acceleration=0.06,
    coefficients={"flight.drag.k": 0.02},
)


def test_mapping_and_back():
    assert TrackNoise.from_mapping(NOISE.to_mapping()) == NOISE
    assert "spin_label" not in NOISE.to_mapping()  # what is not known is not written


def test_dataset_yaml_keeps_it(tmp_path):
    info = DatasetInfo(name="shots", table_height=0.0, ball=TABLE_TENNIS, noise=NOISE)
    write_info(tmp_path / "dataset.yaml", info)
    found, notes = read_info(tmp_path / "dataset.yaml")
    assert (found, notes) == (info, [])


def test_model_file_keeps_it(tmp_path):
    model = nominal_model()
    model.noise = NOISE
    save_model(model, tmp_path / "model.yaml")
    loaded = load_model(tmp_path / "model.yaml")
    assert loaded.noise == NOISE
    assert loaded.measures_plainly  # the noise is no effect


LIMITS = {
    "memory_time": 10.0,
    "stamp_jitter": 1.0,
    "spin_label": 5000.0,
    "spin_prior": 5000.0,
    "acceleration": 100.0,
    "contact_velocity": 50.0,
    "contact_tangential": 50.0,
    "contact_spin": 5000.0,
}


@pytest.mark.parametrize("name", LIMITS)
def test_more_than_any_ball_has_is_in_another_unit(name):
    """In ms, in degrees, in mm/s it would be: what is refused is a thousandth more than what is taken."""
    assert getattr(TrackNoise.from_mapping({name: LIMITS[name]}), name) == LIMITS[name]
    with pytest.raises(ValueError, match=f"noise.{name} must be in .* at most {LIMITS[name]:g}"):
        TrackNoise.from_mapping({name: 1.001 * LIMITS[name]})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([1.0], "noise must be a mapping"),
        ({"memorytime": 0.02}, "memory_time"),
        ({"memory": [0.001, 0.001]}, "noise.memory must be three numbers in m"),
        ({"memory_time": 0.0}, "noise.memory_time must be finite and above 0"),
        ({"position": [1.5, 2.0, 1.1]}, r"noise.position\[0\] must be in m, at most 1"),
        ({"stamp_jitter": -0.001}, "noise.stamp_jitter"),
        ({"acceleration": "much"}, "noise.acceleration"),
        ({"coefficients": {"flight.drag.k": 0.0}}, "noise.coefficients.flight.drag.k"),
    ],
)
def test_wrong_content_is_named(content, message):
    with pytest.raises((ValueError, TypeError), match=message):
        TrackNoise.from_mapping(content)
