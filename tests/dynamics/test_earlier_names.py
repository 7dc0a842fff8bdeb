"""Names of parameters that files and scripts of earlier versions hold: what they mean today."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ballfg.dynamics import Architecture, build, nominal_model
from ballfg.dynamics.coefficient import todays_name
from ballfg.estimation import ExtendedKalmanFilter, Settings, Smoother
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.run.run_folder import Checkpoint, RunProgress
from ballfg.tracks import Track
from tests.small_networks import SMALL


@pytest.mark.parametrize(
    ("name", "today"),
    [
        ("contact.restitution.e", "bounce.restitution.e"),
        ("model.base.contact.friction.mu", "model.base.bounce.friction.mu"),
        ("bounce.restitution.e", "bounce.restitution.e"),
        ("flight.contact.k", "flight.contact.k"),
        ("measurement.my_contact.k", "measurement.my_contact.k"),
    ],
)
def test_coefficients_of_the_bounce_began_with_contact(name: str, today: str) -> None:
    assert todays_name(name) == today
    assert todays_name(name, [name]) == name


def test_estimators_take_the_earlier_names() -> None:
    times = np.linspace(0.0, 0.2, 21)
    track = Track(times, np.stack((4.0 * times, 0.0 * times, 0.5 - 4.905 * times**2), axis=1))
    sigmas = {"flight.drag.k": 0.03, "contact.restitution.e": 0.02}
    for estimator in (Smoother, ExtendedKalmanFilter):
        with pytest.warns(DeprecationWarning, match="earlier name of 'bounce.restitution.e' and will be refused"):
            found = estimator(nominal_model(), 0.0, Settings(coefficients=sigmas)).estimate(track)
        assert found.coefficient_names == ("flight.drag.k", "bounce.restitution.e")


def test_calibrations_take_the_earlier_names() -> None:
    given = {"kind": "calibrate", "coefficients": ["flight.drag.k", "contact.restitution.e"]}
    with pytest.warns(DeprecationWarning, match="Write 'bounce.restitution.e'"):
        config = CalibrationConfig.model_validate(given)
    assert config.coefficients == ("flight.drag.k", "bounce.restitution.e")


def test_checkpoints_of_earlier_versions_are_of_the_same_model() -> None:
    """The coefficients of the base are called otherwise today, the network for the contact is not."""
    architecture = Architecture.of("mnn+gs", **SMALL, residual=True)
    module = torch.nn.ModuleDict({"model": build(architecture, radius=0.02, base=nominal_model())})
    today = module.state_dict()
    earlier = {name.replace("model.base.bounce.", "model.base.contact."): tensor for name, tensor in today.items()}
    assert "model.base.contact.restitution.e" in earlier
    assert any(name.startswith("model.contact.") for name in today)
    moments = {f"{name}/exp_avg": tensor for name, tensor in earlier.items()}
    progress = RunProgress(epoch=1, best_epoch=1, best_rmse=None, skipped_in_row=0, train=1, validation=0)
    found = Checkpoint(progress, earlier, earlier, moments).renamed(today)
    assert found.weights.keys() == found.best.keys() == today.keys()
    assert found.optimizer.keys() == {f"{name}/exp_avg" for name in today}
    assert all(found.weights[name] is tensor for name, tensor in today.items())
