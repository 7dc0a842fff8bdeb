"""Stamps, labels and positions between what happened and what is written down."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from ballfg.dynamics import EFFECTS, AnalyticModel, Surfaces, nominal_model
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.effects.measurement import signed_permutations
from ballfg.dynamics.measurement import Later
from ballfg.dynamics.motion.rollout import advance
from ballfg.dynamics.variation import Variation
from ballfg.estimation.measurement.as_measured import (
    LabelMap,
    measured_positions,
    plainly_measured,
    true_times,
    written_time,
)
from ballfg.tracks import Track

TABLE = Surfaces(0.0)
STATES = torch.tensor(
    [[0.2, 0.3, 0.5, 4.0, -1.0, 1.0, 40.0, -90.0, 60.0], [1.0, 0.0, 0.025, 3.0, 0.0, -2.0, 0.0, 50.0, 0.0]],
    dtype=torch.float64,
)


def measuring(**effects: dict[str, float]) -> AnalyticModel:
    nominal = nominal_model()
    extra = [EFFECTS[name](**values) for name, values in effects.items()]
    return AnalyticModel([*nominal.flight.values(), *nominal.bounce.values(), *extra])


def frame(matrix: np.ndarray) -> dict[str, float]:
    return {a + b: float(matrix[i, j]) for i, a in enumerate("xyz") for j, b in enumerate("xyz")}


class Mirror(AnalyticModel):
    """A model that measures by itself, without a measurement effect."""

    @property
    def measures_plainly(self) -> bool:
        return False

    def measured(self, states: Tensor, later: Later) -> Tensor:
        return -states[..., :3]


def test_the_plain_model_is_the_same_ball() -> None:
    model = measuring(frame_tilt={"x": 0.1}, time_scale={"s": 0.1})
    plain = plainly_measured(model)
    assert plain.measures_plainly
    assert not model.measures_plainly
    assert dict(plain.named_parameters()).keys() == dict(nominal_model().named_parameters()).keys()
    assert all(p is dict(model.named_parameters())[name] for name, p in plain.named_parameters())
    for mine, other in zip(plain.rates(STATES), nominal_model().rates(STATES), strict=True):
        torch.testing.assert_close(mine, other, rtol=0, atol=0)
    torch.testing.assert_close(plain.measured(STATES, lambda _: STATES), STATES[:, :3], rtol=0, atol=0)
    assert plainly_measured(nominal_model()).measures_plainly


def test_coefficients_of_measurement_that_differ_between_tracks() -> None:
    """A plain model keeps those of its motion and knows nothing of the others."""
    model = measuring(time_offset={"x": 0.01})
    rising = Variation("track", {"000": 0.1, "001": 0.2}, line=True)
    model.variations = {"flight.drag.k": rising, "measurement.time_offset.x": rising}
    plain = plainly_measured(model)
    assert plain.variations == {"flight.drag.k": rising}
    track = Track(np.arange(20) / 100.0, np.zeros((20, 3)), name="001")
    assert dict(plain.for_track(track).named_parameters())["flight.drag.k"].item() == pytest.approx(0.2)


def test_augmented_models_too() -> None:
    plain = plainly_measured(AugmentedModel(measuring(scale={"x": 0.1}), ["flight.drag.k"]))
    assert plain.measures_plainly
    assert isinstance(plain, AugmentedModel)
    assert plain.names == ("flight.drag.k",)


def test_a_measurement_that_is_no_effect_is_refused() -> None:
    with pytest.raises(TypeError, match="must get its measurement from measurement effects; Mirror has one"):
        plainly_measured(Mirror([]))


def test_times_there_and_back() -> None:
    written = np.array([1000.0, 1000.011, 1000.5, 1002.02])
    model = measuring(time_scale={"s": 0.01})
    times = true_times(model, written)
    np.testing.assert_allclose(times - 1000.0, (written - 1000.0) / 1.01, rtol=0, atol=1e-9)
    assert times[0] == written[0]
    for true, stamp in zip(times, written, strict=True):
        assert written_time(model, 1000.0, float(true)) == pytest.approx(stamp, abs=1e-9)
    assert true_times(nominal_model(), written) is written


def test_positions_through_a_bounce_and_with_coefficients() -> None:
    """The second ball touches the table within the 10 ms by which z is late: both from the formula of a rollout."""
    model = measuring(time_offset={"z": 0.01}, scale={"x": 0.02})
    found = measured_positions(model, STATES.numpy(), TABLE)
    late = advance(nominal_model(), STATES, torch.full((2,), 0.01, dtype=torch.float64), TABLE).detach().numpy()
    np.testing.assert_allclose(found[:, 0], 1.02 * STATES[:, 0].numpy(), rtol=1e-12)
    np.testing.assert_array_equal(found[:, 1], STATES[:, 1].numpy())
    np.testing.assert_allclose(found[:, 2], late[:, 2], rtol=1e-9)
    assert late[1, 5] > 0.0 > STATES[1, 5]
    augmented = AugmentedModel(model, ["flight.drag.k", "measurement.scale.x"])
    columns = np.array([[0.12, 0.02], [0.12, 0.05]])
    found = measured_positions(augmented, np.hstack((STATES.numpy(), columns)), TABLE)
    np.testing.assert_allclose(found[:, 0], np.array([1.02, 1.05]) * STATES[:, 0].numpy(), rtol=1e-12)


def test_plain_positions_to_the_bit() -> None:
    np.testing.assert_array_equal(measured_positions(nominal_model(), STATES.numpy(), TABLE), STATES[:, :3].numpy())


def test_labels_are_solved_for() -> None:
    spin = np.array([30.0, -120.0, 80.0])
    model = measuring(spin_label_frame=frame(np.array([[0.9, 0.2, 0], [-0.1, 0, 1.1], [0, 1.0, 0.3]])),
                      spin_label_offset={"x": 20.0, "z": -5.0}, spin_label_scale={"s": 0.3})  # fmt: skip
    label = model.labelled(torch.from_numpy(spin)).detach().numpy()
    assert np.abs(label - spin).max() > 50.0
    np.testing.assert_allclose(LabelMap.of(model).spin(label, 5.0, 300.0), spin, rtol=1e-12)


@pytest.mark.parametrize("number", [0, 7, 20, 47])
def test_exchanged_axes_leave_the_noise_alone(number) -> None:
    matrix = signed_permutations()[number].numpy()
    labels = LabelMap.of(measuring(spin_label_frame=frame(matrix)))
    np.testing.assert_array_equal(labels.matrix, matrix)
    assert labels.spread(5.0, 300.0) == pytest.approx(5.0, rel=1e-12)
    assert LabelMap.of(measuring(spin_label_scale={"s": 0.25})).spread(5.0, 300.0) == pytest.approx(4.0, rel=1e-12)


def test_a_label_that_hardly_shows_a_direction_leaves_it_to_the_prior():
    """Solved for, 6 rad/s of noise would be 600 rad/s of spin; turned axes of labels change nothing."""
    turn = signed_permutations()[20].numpy()
    labels = LabelMap.of(measuring(spin_label_frame=frame(turn @ np.diag([1.0, 0.5, 0.01]))))
    spin = labels.spin(turn @ np.array([50.0, -20.0, 6.0]), 5.0, 300.0)
    np.testing.assert_allclose(spin, [50.0, -40.0, 0.0], atol=1e-9)
    assert labels.spread(5.0, 300.0) == pytest.approx(np.sqrt((5.0**2 + 10.0**2 + 300.0**2) / 3.0), rel=1e-12)
    np.testing.assert_allclose(labels.spin(turn @ np.array([50.0, -20.0, 6.0]), 5.0, 600.0)[2], 600.0, rtol=1e-9)
    noisy = LabelMap.of(measuring(spin_label_frame=frame(turn)))
    np.testing.assert_allclose(noisy.spin(turn @ np.array([50.0, -20.0, 6.0]), 300.0, 200.0), [50.0, -20.0, 6.0])
    assert noisy.spread(300.0, 200.0) == pytest.approx(300.0, rel=1e-8)


def test_labels_that_tell_no_spin_are_refused() -> None:
    flat = measuring(spin_label_frame=frame(np.diag([1.0, 1.0, 0.0])))
    with pytest.raises(ValueError, match="give different spins different labels; its effects"):
        LabelMap.of(flat)
