"""A network's correction outside of its training data: it fades, its doubt grows, and files and rooms keep that."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ballfg.dynamics import Architecture, build, load_model, nominal_model, save_model
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.motion.integrate import fly_jacobian
from ballfg.dynamics.networks.fading import (
    ABROAD,
    EDGE,
    MOST_CENTRES,
    Fading,
    FeatureDensity,
    states_before_contacts,
)
from ballfg.dynamics.networks.learned import LearnedModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.dynamics.trained import Trained
from ballfg.estimation.configure import dataset_settings, widened, with_usual_noise
from ballfg.estimation.out_of_distribution import out_of_distribution, out_of_distribution_share
from ballfg.estimation.settings import MEASURED
from ballfg.factors.noise import ProcessNoise
from ballfg.prediction.belief import Belief
from ballfg.prediction.propagate import Propagator
from ballfg.tracks.noise import TrackNoise
from tests.small_networks import SMALL

FAR = (0.0, 0.0, 1.0, 0.2, 0.1, -0.3, 900.0, -800.0, 700.0)
HALF_WAY = (0.0, 0.0, 1.0, 3.9, 0.2, -1.5, 8.0, 118.0, 6.0)


def states(seed: int, count: int = 40) -> torch.Tensor:
    """Flights of one launcher: some 4 m/s forwards and down, some 80 rad/s of topspin."""
    spread = torch.tensor([0.1, 0.1, 0.1, 0.4, 0.3, 0.3, 10.0, 20.0, 10.0], dtype=torch.float64)
    mean = torch.tensor([0.0, 0.0, 1.0, 4.0, 0.0, -1.5, 0.0, 80.0, 0.0], dtype=torch.float64)
    noise = torch.randn((count, 9), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return mean + spread * noise


@pytest.fixture
def model() -> LearnedModel:
    base = nominal_model(0.02)
    made = build(Architecture.of("mnn+gs", **SMALL, residual=True), radius=0.02, base=base)
    for part in (made.flight, made.contact):
        torch.nn.init.normal_(part.network.last.weight, std=1.5, generator=torch.Generator().manual_seed(1))
    tracks = [states(seed, 12) for seed in range(20)]
    made.fading = Fading.of(tracks, [track[:4] for track in tracks], 0.02)
    flying = torch.cat(tracks)
    made.requires_grad_(False)
    guess = base.after_bounce(flying)
    made.fading.measure(made.flight(flying)[0], made.contact(flying, guess) - guess)
    return made


def row(values) -> torch.Tensor:
    return torch.tensor([values], dtype=torch.float64)


def test_the_weight_is_that_of_a_kernel_density_worked_out_by_hand(model):
    density = model.fading.flying
    point = np.array([0.6, 0.9, 0.8])
    square = (((point / density.spread.numpy() - density.centres.numpy()) / density.width.item()) ** 2).sum(axis=1)
    mean = np.exp(-0.5 * square).mean()
    assert density(torch.from_numpy(point)).item() == pytest.approx(mean / (mean + density.edge.item()), rel=1e-12)


def test_the_weight_is_one_inside_and_falls_to_zero_far_away(model):
    inside = model.inside(states(99, 200))
    assert inside.median() > 0.9
    assert (inside > 0.5).double().mean() > 0.85
    assert model.inside(row(FAR)).item() < 1e-6
    line = row(states(0)[0].tolist()) + torch.linspace(0, 1, 50, dtype=torch.float64)[:, None] * (
        row(FAR) - row(states(0)[0].tolist())
    )
    assert (model.inside(line).diff() < 0.05).all()


def test_far_away_the_model_is_its_base_and_inside_it_is_corrected(model):
    far, near = row(FAR), states(5)[:1]
    torch.testing.assert_close(model.rates(far)[0], model.base.rates(far)[0], rtol=0, atol=1e-5)
    full = model.base.rates(near)[0] + model.flight(near)[0]
    weight = model.inside(near).item()
    expected = weight * full + (1 - weight) * model.base.rates(near)[0]
    torch.testing.assert_close(model.rates(near)[0], expected)
    torch.testing.assert_close(model.after_bounce(far), model.base.after_bounce(far), rtol=0, atol=1e-3)


@pytest.mark.parametrize("what", ["rates", "after_bounce"])
@pytest.mark.parametrize("doubt", [0.0, 0.7])
def test_derivatives_in_the_fading_are_central_differences(model, what, doubt):
    model.fading.flight.fill_(doubt)
    model.fading.contact.fill_(doubt)

    def values(state):
        return model.rates(state)[0] if what == "rates" else model.after_bounce(state)

    point, step = row(HALF_WAY)[0], 1e-5
    assert 0.02 < model.inside(point).item() < 0.98
    exact = torch.autograd.functional.jacobian(values, point)
    columns = [(values(point + step * e) - values(point - step * e)) / (2 * step) for e in torch.eye(9).double()]
    torch.testing.assert_close(exact, torch.stack(columns, dim=-1), rtol=1e-5, atol=1e-7)


@pytest.mark.usefixtures("networks_in_torch")
def test_the_jacobian_of_a_flight_has_the_doubt_of_the_correction(model):
    augmented = AugmentedModel(model, ("fading.flight", "base.flight.drag.k"))
    start = augmented.append(row(HALF_WAY), augmented.means())
    dt, step = torch.tensor([0.02], dtype=torch.float64), 1e-5
    _, jacobian = fly_jacobian(augmented, start, dt)
    for k in (9, 10):
        one = torch.zeros_like(start)
        one[0, k] = step
        change = fly_jacobian(augmented, start + one, dt)[0] - fly_jacobian(augmented, start - one, dt)[0]
        torch.testing.assert_close(jacobian[0, :, k], change[0] / (2 * step), rtol=1e-5, atol=1e-8)
        assert jacobian[0, 3:6, k].norm() > 0


def test_turning_about_the_vertical_turns_rates_and_bounces(model):
    model.fading.flight.fill_(0.5)
    model.fading.contact.fill_(0.5)
    angle = torch.tensor(0.83)
    turn = torch.eye(3, dtype=torch.float64)
    turn[0, 0] = turn[1, 1] = angle.cos().double()
    turn[1, 0], turn[0, 1] = angle.sin().double(), -angle.sin().double()
    whole = torch.block_diag(turn, turn, turn)
    point = row(HALF_WAY)
    torch.testing.assert_close(model.rates(point @ whole.T)[0], model.rates(point)[0] @ turn.T)
    torch.testing.assert_close(model.after_bounce(point @ whole.T), model.after_bounce(point) @ whole.T)
    torch.testing.assert_close(model.inside(point @ whole.T), model.inside(point))


@pytest.mark.usefixtures("networks_in_torch")
def test_uncertainty_grows_with_the_distance_by_at_most_the_usual_correction(model):
    propagator = Propagator(Surfaces(-5.0), ProcessNoise(acceleration=0.01))
    sigmas = []
    for start in (states(5)[0].tolist(), HALF_WAY):
        augmented = AugmentedModel(model, ("fading.flight",))
        mean = augmented.append(row(start), augmented.means())
        covariance = torch.diag(torch.tensor([1e-8] * 9 + [1.0], dtype=torch.float64))[None]
        belief = Belief(augmented, torch.zeros(1, dtype=torch.float64), mean, covariance)
        sigmas.append(np.sqrt(np.trace(propagator.rollout(belief, [0.2]).covariances[0, 0, :3, :3])))
    assert sigmas[1] > 2 * sigmas[0]
    assert sigmas[1] < 0.5 * model.fading.acceleration.item() * 0.2**2 + 0.01


def test_few_tracks_with_contacts_leave_the_bounce_to_the_base(model):
    tracks = [states(seed, 12) for seed in range(20)]
    fading = Fading.of(tracks, [track[:1] for track in tracks[:3]], 0.02)
    model.fading = fading
    torch.testing.assert_close(model.after_bounce(states(5)), model.base.after_bounce(states(5)))


def test_states_before_contacts_are_the_last_ones_that_fall():
    path = torch.zeros((6, 9), dtype=torch.float64)
    path[:, 5] = torch.tensor([-1.0, -2.0, 1.5, -0.1, 0.1, -1.0])
    assert states_before_contacts(path)[:, 5].tolist() == [-2.0]


def trained() -> Trained:
    noise = TrackNoise(acceleration=0.06, spin_prior=25.0, coefficients={"base.flight.drag.k": 0.02})
    return Trained({"acceleration": 0.08}, rooms=("hall", "lab"), elsewhere=noise)


def test_a_saved_and_loaded_model_is_the_same(model, tmp_path):
    model.trained = trained()
    save_model(model, tmp_path / "model.yaml")
    again = load_model(tmp_path / "model.yaml")
    for point in (row(HALF_WAY), row(FAR), states(5)):
        assert torch.equal(again.rates(point)[0], model.rates(point)[0])
        assert torch.equal(again.after_bounce(point), model.after_bounce(point))
    assert again.trained == replace(model.trained)
    assert again.fading.acceleration == model.fading.acceleration


def test_in_a_foreign_room_half_of_the_correction_is_left(model, tmp_path):
    model.trained = trained()
    save_model(model, tmp_path / "model.yaml")
    home, abroad = (load_model(tmp_path / "model.yaml", room=room) for room in ("hall", "gym"))
    point = states(5)
    correction = model.rates(point)[0] - model.base.rates(point)[0]
    assert torch.equal(home.rates(point)[0], model.rates(point)[0])
    torch.testing.assert_close(abroad.rates(point)[0] - model.base.rates(point)[0], ABROAD * correction)
    save_model(abroad, tmp_path / "again.yaml")
    assert torch.equal(load_model(tmp_path / "again.yaml").rates(point)[0], model.rates(point)[0])


def test_coefficients_are_estimated_in_foreign_rooms_only(model):
    model.trained = trained()

    def settings(room):
        info = SimpleNamespace(position_noise=0.001, spin_noise=None, noise=None, name=room)
        return dataset_settings(SimpleNamespace(info=info, rough=False, one_view=False), model)

    assert not settings("hall").coefficients
    assert settings("hall").process.acceleration == 0.08
    abroad = settings("gym")
    assert abroad.coefficients["base.flight.drag.k"] == 0.02
    assert abroad.coefficients["fading.flight"] == abroad.coefficients["fading.contact"] == 1.0
    assert (abroad.process.acceleration, abroad.spin_prior) == (0.06, 25.0)
    assert with_usual_noise(abroad, model, 0.0).process == abroad.process
    assert with_usual_noise(abroad, model, 1.0).process.acceleration == pytest.approx(MEASURED.acceleration)
    kick = 0.5 * model.fading.velocity.item() / np.sqrt(3.0)
    bounces = np.hypot(abroad.process.contact_velocity, kick)
    assert widened(abroad.process, model, 0.5) == replace(abroad.process, contact_velocity=float(bounces))
    assert widened(abroad.process, nominal_model(), 0.5) == abroad.process  # of which nothing was trained


def test_the_share_outside_is_one_less_the_weight(model):
    near, far = states(5).numpy(), np.array([FAR] * 3)
    assert out_of_distribution(model, far) == pytest.approx(1.0, abs=1e-6)
    assert out_of_distribution(model, near) == pytest.approx(1.0 - model.inside(torch.from_numpy(near)).numpy())
    assert out_of_distribution_share(model, [near, far]) == pytest.approx(
        (out_of_distribution(model, near).mean() + 1.0) / 2, abs=1e-6
    )
    assert out_of_distribution(nominal_model(0.02), near) is None
    assert out_of_distribution_share(nominal_model(0.02), [near]) is None


def test_a_density_without_kernels_is_nowhere():
    density = FeatureDensity(0, 3)
    assert torch.equal(density(torch.rand(4, 3, dtype=torch.float64)), torch.zeros(4, 1, dtype=torch.float64))


@pytest.mark.parametrize("count", [20, 88, 120, 300])
def test_further_flights_of_the_same_launcher_are_inside_however_many_trained(count):
    """A flight changes on its way: one sample of each of many tracks must show all of it, and not the launch alone."""
    rng = np.random.default_rng(4)

    def flight() -> np.ndarray:
        """(60, 3) features that run on from a launch."""
        launch, way = rng.normal((0.2, 0.5, -0.3), 0.02), np.linspace(0.0, 1.0, 60)[:, None]
        return launch + way * (0.4, -0.3, 0.5) + rng.normal(0.0, 0.005, (60, 3))

    density = FeatureDensity.of([flight() for _ in range(count)], 3)
    assert len(density.centres) <= MOST_CENTRES
    weights = density(torch.tensor(np.array([flight() for _ in range(100)])))[..., 0].numpy()
    for part in (weights[:, :20], weights[:, 20:40], weights[:, 40:]):
        assert (part < 0.5).mean() < 3.0 * EDGE
    assert float(density(torch.tensor([[0.2, 0.5, 0.6], [-0.6, 0.2, 0.0]])).max()) < 0.01  # elsewhere
