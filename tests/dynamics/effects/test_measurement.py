"""Measurement effects: what is written down, against formulas, in their fixed order, and its derivatives."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.autograd import forward_ad

from ballfg.dynamics import EFFECTS, AnalyticModel, Architecture, build
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.effects.generic import GenericMeasurement
from ballfg.dynamics.effects.measurement import SOFT_DISTANCE, signed_permutations
from ballfg.dynamics.model import substitute
from ballfg.dynamics.model_file import model_from_dict, model_to_dict
from ballfg.dynamics.motion.integrate import fly

STATE = torch.tensor([[1.2, 0.3, 1.1, 5.0, -1.0, 2.0, 40.0, -150.0, 60.0]], dtype=torch.float64)
POSITION, VELOCITY, SPIN = STATE[0, :3].numpy(), STATE[0, 3:6].numpy(), STATE[0, 6:].numpy()
DOWN = np.array([0.0, 0.0, -9.81])
ALL = {
    "spin_label_offset": {"x": 20.0, "z": -5.0},
    "distortion": {"k": 0.008, "x": 1.0, "y": 0.2, "z": 1.0},
    "counted_frames": {"missing": 0.3},
    "radial_bias": {"offset": 0.02, "x": -1.0, "y": 0.5, "z": 2.0},
    "scale": {"x": 0.01, "y": -0.02, "z": 0.03},
    "time_scale": {"s": 0.01},
    "frame_tilt": {"x": 0.1, "y": -0.2},
    "spin_label_scale": {"s": 0.2},
    "velocity_lag": {"lag": 0.003},
    "spin_label_frame": {"xx": 0.0, "xy": 1.0, "yx": -1.0, "yy": 0.0},
    "time_offset": {"x": -0.004, "y": 0.002, "z": 0.001},
}


def measuring(**effects):
    return AnalyticModel([EFFECTS["gravity"](), *(EFFECTS[n](**v) for n, v in effects.items())])


def seen(model, state=STATE):
    """Positions as measured of a ball that only falls."""
    vacuum = AnalyticModel([EFFECTS["gravity"](g=9.81)])
    with torch.no_grad():
        return model.measured(state, lambda delay: fly(vacuum, state, delay.expand(len(state))))[0].numpy()


def test_nothing_is_measured_as_it_is():
    model = measuring()
    assert model.measures_plainly
    assert torch.equal(model.measured(STATE, pytest.fail), STATE[:, :3])
    assert model.true_stamps(STATE) is model.stamps(STATE) is model.labelled(STATE) is STATE
    assert not measuring(time_scale={}).measures_plainly


def test_frame_tilt_is_a_rotation():
    expected = Rotation.from_rotvec([0.1, -0.2, 0.0]).apply(POSITION)
    np.testing.assert_allclose(seen(measuring(frame_tilt=ALL["frame_tilt"])), expected, atol=1e-14)


def test_scale_is_a_stretch():
    np.testing.assert_allclose(seen(measuring(scale={"y": 0.1})), POSITION * [1, 1.1, 1], rtol=1e-15)


def test_radial_bias_points_away_from_its_centre():
    away = POSITION - [-1.0, 0.5, 2.0]
    moved = seen(measuring(radial_bias=ALL["radial_bias"])) - POSITION
    np.testing.assert_allclose(moved, 0.02 * away / np.sqrt(away @ away + SOFT_DISTANCE**2), atol=1e-15)
    assert np.linalg.norm(moved) == pytest.approx(0.02, rel=3e-4)


def test_distortion_grows_with_the_square_of_the_distance():
    away = POSITION - [1.0, 0.2, 1.0]
    moved = seen(measuring(distortion=ALL["distortion"])) - POSITION
    np.testing.assert_allclose(moved, 0.008 * (away @ away) * away, atol=1e-15)


def test_counted_frames_are_a_slow_clock_on_average():
    model, times = measuring(counted_frames={"missing": 0.25}), torch.linspace(0.0, 2.0, 50, dtype=torch.float64)
    torch.testing.assert_close(model.stamps(times), times / 1.25, rtol=1e-15, atol=0)
    torch.testing.assert_close(model.true_stamps(model.stamps(times)), times, rtol=0, atol=1e-12)


@pytest.mark.parametrize("lag", [0.005, -0.005])
def test_velocity_lag_is_a_shift_of_the_clock_within_a_flight(lag):
    moved = seen(measuring(velocity_lag={"lag": lag}))
    np.testing.assert_allclose(moved, POSITION - lag * VELOCITY, rtol=1e-15)
    earlier = POSITION - lag * VELOCITY + lag**2 / 2 * DOWN
    np.testing.assert_allclose(moved, earlier, atol=lag**2 / 2 * 9.81 * 1.001)


@pytest.mark.parametrize(
    ("offsets", "delays"),
    [
        ((0.0, 0.0, 0.004), (0.0, 0.0, 0.004)),
        ((-0.004, 0.002, 0.001), (0.0, 0.006, 0.005)),
        ((0.02, 0.02, 0.02), (0.0, 0.0, 0.0)),  # a shift of the clock
    ],
)
def test_time_offset_reads_each_coordinate_at_its_moment(offsets, delays):
    t = np.array(delays)
    expected = POSITION + t * VELOCITY + t**2 / 2 * DOWN
    model = measuring(time_offset=dict(zip("xyz", offsets, strict=True)))
    np.testing.assert_allclose(seen(model), expected, atol=1e-14)


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")  # torch's, in forward mode
def test_derivatives_of_time_offset():
    """Away from ties those of the differences; at zero those of each camera's own moment, less their mean's."""
    names = [f"measurement.time_offset.{axis}" for axis in "xyz"]
    model, velocity = measuring(time_offset={}), STATE[:, 3:6]

    def moving(delay):
        return torch.cat((STATE[:, :3] + delay.reshape(-1, 1) * velocity, STATE[:, 3:]), dim=-1)

    def positions(*offsets):
        return substitute(model, dict(zip(names, offsets, strict=True))).measured(STATE, moving)

    apart = [torch.tensor([[v]], dtype=torch.float64, requires_grad=True) for v in (-0.004, 0.002, 0.001)]
    assert torch.autograd.gradcheck(positions, apart, check_forward_ad=True, eps=1e-5)
    assert torch.autograd.gradgradcheck(positions, apart, eps=1e-5)
    zero, own_moment = [torch.zeros((1, 1), dtype=torch.float64) for _ in range(3)], torch.eye(3, dtype=torch.float64)
    with forward_ad.dual_level():
        for i in range(3):
            duals = [forward_ad.make_dual(z, torch.full_like(z, float(j == i))) for j, z in enumerate(zero)]
            tangent = forward_ad.unpack_dual(positions(*duals)).tangent
            expected = (own_moment[i] - 1 / 3) * velocity[0]
            torch.testing.assert_close(tangent[0], expected, rtol=0, atol=1e-14)


def test_time_scale_there_and_back():
    model = measuring(time_scale={"s": 0.02})
    times = torch.linspace(0.0, 2.0, 50, dtype=torch.float64)
    stamps = model.stamps(times)
    torch.testing.assert_close(stamps, 1.02 * times, rtol=1e-15, atol=0)
    torch.testing.assert_close(model.true_stamps(stamps), times, rtol=0, atol=1e-12)
    rows = substitute(model, {"measurement.time_scale.s": torch.tensor([[0.1], [0.2]], dtype=torch.float64)})
    torch.testing.assert_close(rows.stamps(times[:, None, None])[..., 0], times[:, None] * torch.tensor([1.1, 1.2]))


def test_every_effect_undoes_its_stamps():
    model = measuring(**ALL)
    times = torch.linspace(0.0, 2.0, 50, dtype=torch.float64)
    torch.testing.assert_close(model.true_stamps(model.stamps(times)), times, rtol=0, atol=1e-12)


def test_labels():
    spin = STATE[:, 6:]
    w = SPIN
    for effects, expected in (
        ({"spin_label_scale": {"s": -2.0}}, -w),
        ({"spin_label_offset": {"x": 20.0, "z": -5.0}}, w + np.array([20, 0, -5])),
        ({"spin_label_frame": ALL["spin_label_frame"]}, [w[1], -w[0], w[2]]),
        ({name: ALL[name] for name in reversed(ALL)}, np.array([w[1], -w[0], w[2]]) * 1.2 + [20, 0, -5]),
    ):
        np.testing.assert_allclose(measuring(**effects).labelled(spin)[0].detach(), expected, rtol=1e-14)


def test_signed_permutations():
    matrices = signed_permutations()
    assert matrices.shape == (48, 3, 3)
    assert torch.equal(matrices[0], torch.eye(3, dtype=torch.float64))
    assert len({tuple(m.flatten().tolist()) for m in matrices}) == 48
    assert torch.equal(matrices @ matrices.mT, torch.eye(3, dtype=torch.float64).expand(48, 3, 3))
    assert sorted(torch.linalg.det(matrices).round().tolist()) == [-1.0] * 24 + [1.0] * 24
    (last,) = matrices[-1:]
    values = {a + b: float(last[i, j]) for i, a in enumerate("xyz") for j, b in enumerate("xyz")}
    label = measuring(spin_label_frame=values).labelled(STATE[:, 6:])
    torch.testing.assert_close(label[0], last @ STATE[0, 6:], rtol=0, atol=0)


def test_effects_act_in_one_order_whatever_the_files():
    order = [
        "time_offset",
        "velocity_lag",
        "frame_tilt",
        "scale",
        "radial_bias",
        "distortion",
        "counted_frames",
        "time_scale",
        "spin_label_frame",
        "spin_label_scale",
        "spin_label_offset",
    ]
    forward, backward = measuring(**ALL), measuring(**{name: ALL[name] for name in reversed(ALL)})
    assert list(forward.measurement) == list(backward.measurement) == order
    np.testing.assert_array_equal(seen(forward), seen(backward))
    delays = np.array([0.0, 0.006, 0.005])
    p = POSITION + delays * VELOCITY + delays**2 / 2 * DOWN - 0.003 * VELOCITY
    p = Rotation.from_rotvec([0.1, -0.2, 0.0]).apply(p) * [1.01, 0.98, 1.03]
    away = p - [-1.0, 0.5, 2.0]
    p = p + 0.02 * away / np.sqrt(away @ away + SOFT_DISTANCE**2)
    away = p - [1.0, 0.2, 1.0]
    np.testing.assert_allclose(seen(forward), p + 0.008 * (away @ away) * away, atol=1e-13)


@pytest.mark.parametrize("turned", [False, True])
def test_a_pattern_over_places_acts_on_positions_that_are_late(turned):
    effects = [EFFECTS["gravity"](), GenericMeasurement(x_x=0.1, center_x=0.0), EFFECTS["velocity_lag"](lag=0.003)]
    late = POSITION - 0.003 * VELOCITY
    expected = late + np.array([0.1 * late[0], 0.0, 0.0])
    np.testing.assert_allclose(seen(AnalyticModel(effects[::-1] if turned else effects)), expected, atol=1e-14)


def test_in_a_model_file_and_among_the_coefficients():
    model = model_from_dict({"flight": {}, "bounce": {}, "measurement": ALL})
    assert model_to_dict(model_from_dict(model_to_dict(model))) == model_to_dict(model)
    assert model_to_dict(model)["measurement"]["scale"] == ALL["scale"]
    assert "measurement.radial_bias.offset" in model.declared_coefficients()
    assert "measurement.radial_bias.offset" in dict(model.named_parameters())


def test_other_models_measure_as_the_one_inside():
    base = measuring(**ALL)
    learned = build(Architecture.of("mlp", residual=True), radius=0.02, base=base)
    augmented = AugmentedModel(base, ("measurement.scale.x",))
    wide = augmented.append(STATE, torch.tensor([0.01], dtype=torch.float64))
    vacuum = AnalyticModel([EFFECTS["gravity"](g=9.81)])
    for model, state in ((learned, STATE), (augmented, wide)):
        with torch.no_grad():
            positions = model.measured(state, lambda delay: fly(vacuum, STATE, delay.expand(1)))[0].numpy()
        np.testing.assert_allclose(positions, seen(base), rtol=1e-15)
        assert not model.measures_plainly
        for method in ("true_stamps", "stamps", "labelled"):
            assert torch.equal(getattr(model, method)(STATE[:, :3]), getattr(base, method)(STATE[:, :3]))
    alone = build(Architecture.of("mlp"), radius=0.02)
    assert alone.measures_plainly
    assert torch.equal(alone.measured(STATE, pytest.fail), STATE[:, :3])
    assert alone.true_stamps(STATE) is alone.stamps(STATE) is alone.labelled(STATE) is STATE
