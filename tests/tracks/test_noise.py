"""The noise that a file states: round trips, limits, messages."""

import pytest

from ballfg.dynamics import load_model, nominal_model, save_model
from ballfg.estimation import dataset_settings
from ballfg.tracks import TABLE_TENNIS, Track
from ballfg.tracks.dataset import dataset_in_memory
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


def written(folder, coefficients):
    """A model file with spreads of coefficients."""
    model = nominal_model()
    model.noise = TrackNoise(coefficients=coefficients)
    save_model(model, folder / "model.yaml")
    return folder / "model.yaml"


NO_COEFFICIENT = [
    ("flight.dragg.k", r"unknown coefficient 'flight.dragg.k'; did you mean 'flight.drag.k'\?$"),
    ("flight.drag_by_sped.k", r"'flight.drag_by_sped.k'; did you mean 'flight\.drag\S*'\?$"),
    ("spin", r"'spin'; known ones: flight.gravity.g, .*\. That of an effect of your own needs --effects-file FILE.py$"),
]


@pytest.mark.parametrize(("name", "message"), NO_COEFFICIENT)
def test_a_spread_of_no_coefficient_is_refused(tmp_path, name, message):
    with pytest.raises(ValueError, match=rf"model.yaml: measurement.noise.coefficients: .*{message}"):
        load_model(written(tmp_path, {name: 0.05}))
    info = DatasetInfo("shots", 0.0, TABLE_TENNIS, position_noise=0.001, noise=TrackNoise(coefficients={name: 0.05}))
    data = dataset_in_memory(info, [Track([0.0, 0.1], [[0.0, 0.0, 1.0]] * 2)])
    with pytest.raises(ValueError, match=rf"dataset.yaml of 'shots': noise.coefficients: .*{message}"):
        dataset_settings(data, nominal_model())


def test_spreads_of_other_models_may_stand_in_a_file(tmp_path):
    """Of an effect that this model lacks, of a network's base and of its doubts, and under an earlier name."""
    names = ("flight.wind.x", "base.flight.drag.k", "fading.flight", "contact.restitution.e")
    spreads = dict.fromkeys(names, 0.01)
    assert load_model(written(tmp_path, spreads)).noise.coefficients == {
        name.removeprefix("base."): sigma for name, sigma in spreads.items()
    }
    info = DatasetInfo("shots", 0.0, TABLE_TENNIS, position_noise=0.001, noise=TrackNoise(coefficients=spreads))
    data = dataset_in_memory(info, [Track([0.0, 0.1], [[0.0, 0.0, 1.0]] * 2)])
    assert "flight.wind.x" not in dataset_settings(data, nominal_model()).coefficients


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
