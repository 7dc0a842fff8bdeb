"""The measured tracks, where they are at hand: at ../shared/data from the project's root, or in $BALLFG_DATA."""

import numpy as np
import pytest

from ballfg.dynamics import Surfaces, nominal_model
from ballfg.estimation.measurement.position_noise import estimate_position_noise
from ballfg.estimation.segmentation.physics import physics_of
from ballfg.estimation.segmentation.result import Quality
from ballfg.tracks import read_dataset
from tests.estimation.segmentation.whole_tracks import segment
from tests.places import DATA

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason=f"no measured tracks at {DATA}; set BALLFG_DATA")


@pytest.fixture(scope="module")
def segmented():
    """Segments every track of a dataset with the noise read off it, on a table of unknown extent above a floor."""

    def run(name):
        dataset = read_dataset(DATA / name)
        sigma = estimate_position_noise(dataset)
        surfaces = Surfaces.table_tennis(dataset.info.table_height)
        physics = physics_of(nominal_model(dataset.info.ball))
        return [segment(t.times, t.positions, sigma, surfaces=surfaces, physics=physics) for t in dataset]

    return run


def test_ballgun_one_contact_each_and_no_hit(segmented):
    found = segmented("ballgun")
    assert [len(s.contacts) for s in found] == [1] * 52
    assert sum(len(s.hits) for s in found) == 0


def test_aimy_no_hit(segmented):
    found = segmented("aimy")
    assert sum(len(s.hits) for s in found) == 0
    assert {len(s.contacts) for s in found} == {0, 1}
    assert 75 <= sum(len(s.contacts) for s in found) <= 80
    assert np.mean(np.concatenate([s.usable for s in found])) > 0.998


def test_robot_rallies(segmented):
    found = segmented("robot_rallies")
    assert 168 <= sum(len(s.contacts) for s in found) <= 180
    assert 60 <= sum(len(s.hits) for s in found) <= 75
    assert all(len(s.hits) >= 1 for s in found)  # the robot hits every ball
    assert max(len(s.contacts) for s in found) >= 10
    quality = np.concatenate([s.quality for s in found])
    assert (quality == Quality.OUTLIER).sum() < 80
    assert 0.01 < (quality == Quality.SHIFTED).mean() < 0.05
