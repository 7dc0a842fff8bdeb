"""One hypothesis at a contact: how its mean and covariance go through the bounce."""

import numpy as np

from ballfg.dynamics import Surfaces, nominal_model
from ballfg.estimation.segmentation.bank import HYPOTHESIS, Scene
from ballfg.estimation.segmentation.physics import physics_of
from ballfg.estimation.segmentation.settings import SegmentationSettings
from ballfg.estimation.segmentation.surface_contact import _bounce


def test_a_covariance_goes_through_the_jacobian_of_the_bounce() -> None:
    rng = np.random.default_rng(2)
    scene = Scene(physics_of(nominal_model()), Surfaces(0.76), SegmentationSettings())
    e = float(scene.numbers["restitution"])
    rows = np.zeros(1, dtype=HYPOTHESIS)
    rows["mean"] = [[[0.3, 4.0, 0.1], [-0.2, 1.0, 0.0], [0.779, -3.0, 0.2]]]
    mix = rng.normal(size=(3, 3, 3))
    before = mix @ mix.swapaxes(-1, -2)
    rows["cov"] = before
    _bounce(rows[0], scene.rows[0], scene.numbers)
    mean, after = rows["mean"][0], rows["cov"][0]
    np.testing.assert_allclose(mean[2], (scene.rows[0]["centre"], 3.0 * e, 0.2))
    keep = mean[0, 1] / 4.0
    assert 1.0 - float(scene.numbers["most_slowing"]) <= keep < 1.0
    assert mean[1, 1] == keep
    for axis, diagonal in enumerate(((1.0, keep, 1.0), (1.0, keep, 1.0), (-e, -e, 1.0))):
        np.testing.assert_array_equal(after[axis], after[axis].T)
        through = np.outer(diagonal, diagonal) * before[axis]
        apart = ~np.eye(3, dtype=bool)
        np.testing.assert_allclose(after[axis][apart], through[apart], rtol=1e-12)
        assert (np.diagonal(after[axis]) > np.diagonal(through)).all()  # what a contact leaves open comes on top
