"""Estimates to take gradients of: a few short tracks with bounces, solved anew wherever the parameters are put."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from ballfg.dynamics import EFFECTS, AnalyticModel, BallModel, Surfaces, rollout
from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.estimation.launcher import Launcher
from ballfg.estimation.segmentation.result import Segmentation
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.problem import effective_sigmas
from ballfg.estimation.smoother.settle import Earlier, Solution
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.batch import Values
from ballfg.factors.graph import Convergence, LevenbergMarquardt
from ballfg.factors.loss import Loss
from ballfg.factors.noise import ProcessNoise
from ballfg.learning.config.training import LossConfig
from ballfg.learning.end_to_end.end_to_end import EndToEnd
from ballfg.learning.end_to_end.learnables import Learnables, NoiseScales
from ballfg.learning.gradient.conjugate_gradients import ConjugateGradients, GaussNewtonFactors
from ballfg.learning.gradient.implicit import GradientMethod
from ballfg.learning.gradient.objective import BatchObjective
from ballfg.learning.training_data import TrainingShot, shots_of
from ballfg.tracks import Track

TABLE = Surfaces(0.0)
TIGHT = LevenbergMarquardt(tolerance=1e-11, max_iterations=300)
"""Where a spin lies in the tail of Huber's loss the iteration creeps: up to 60 steps were seen."""
NOISE = ProcessNoise(acceleration=0.5, spin=30.0, contact_velocity=0.05, contact_tangential=0.1, contact_spin=8.0)
SETTINGS = Settings(
    position_noise=(0.002, 0.002, 0.003),
    process=NOISE,
    spin_prior=100.0,
    spin_label_noise=15.0,
    loss=Loss("huber", 1.5),
    spin_loss=Loss("huber", 1.0),
    label_loss=Loss("cauchy", 3.0),
    find_events=False,
)
STARTS = (
    (0.0, 0.0, 0.22, 4.0, 0.5, -1.5, 10.0, 150.0, 30.0),
    (0.1, 0.2, 0.20, 3.0, -1.0, -1.6, -20.0, -100.0, 60.0),
    (0.2, -0.1, 0.24, 5.0, 0.2, -1.2, 40.0, 60.0, -50.0),
)
LENGTHS = (15, 12, 18)
LONG = (36, 30, 40)
OBSERVED = 14
LABELS = ({"topspin": 2.0, "sidespin": 1.0}, {"spin_x": -5.0, "spin_y": -80.0, "spin_z": 30.0}, {})
"""Of the three tracks: settings of a launcher, a spin label, nothing."""


def ball(**values: dict[str, float]) -> AnalyticModel:
    """Effects with their parameters, in the order of `EFFECTS`."""
    return AnalyticModel([EFFECTS[name](**values[name]) for name in EFFECTS if name in values])


def usual_ball() -> AnalyticModel:
    """A model with a parameter of every sort, none at a special place."""
    return ball(
        gravity={"g": 9.79},
        drag={"k": 0.13},
        magnus={"k": 0.0031},
        spin_decay={"rate": 0.3},
        restitution={"e": 0.91},
        friction={"mu": 0.22},
        tangential_restitution={"e_t": 0.2},
        table_height={"offset": -0.002},
    )


def measured(
    model: BallModel, starts: Sequence[Sequence[float]] = STARTS, lengths: Sequence[int] = LENGTHS
) -> list[Track]:
    """Tracks with a bounce each, stamps of uneven length, noise of 3 mm and a sample 9 mm off."""
    tracks = []
    for k, (start, length) in enumerate(zip(starts, lengths, strict=True)):
        rng = np.random.default_rng(k)
        times = 0.5 + np.cumsum(rng.uniform(0.009, 0.015, length))
        since = torch.from_numpy(times - times[0])
        with torch.no_grad():
            states = rollout(model, torch.tensor([start], dtype=torch.float64), since, TABLE)[0].numpy()
        positions = states[:, :3] + 0.003 * rng.standard_normal((length, 3))
        positions[length // 3, 1] += 0.009
        tracks.append(Track(times, positions, labels=LABELS[k % 3], name=f"track {k}"))
    return tracks


@dataclass
class Estimates:
    """Some tracks and everything that their estimates depend on; `solve` follows the parameters as they are now."""

    model: BallModel
    tracks: Sequence[Track]
    settings: Settings = SETTINGS
    noise: NoiseScales = field(default_factory=lambda: NoiseScales(NOISE, learned=False))
    surfaces: Surfaces = TABLE
    segmentations: Sequence[Segmentation] = ()
    starts: Sequence[Values] = ()

    def __post_init__(self) -> None:
        """Contacts stay in the intervals in which the first solution has them."""
        smoother = Smoother(self.model, self.surfaces, self.noise.settings(self.settings), TIGHT)
        self.segmentations = [smoother.segment(track) for track in self.tracks]
        found = self.solve()
        self.segmentations = [replace(s.events.segmentation, contacts=s.events.contacts) for s in found]
        self.starts = [s.minimum.values for s in self.solve()]

    def solve(self) -> list[Solution]:
        smoother = Smoother(self.model, self.surfaces, self.noise.settings(self.settings), TIGHT)
        scale, found = self.noise.position_scale(), []
        for k, (track, events) in enumerate(zip(self.tracks, self.segmentations, strict=True)):
            sigma = effective_sigmas(track, events, self.settings) * scale
            earlier = Earlier(self.starts[k]) if self.starts else None
            found.append(smoother.settle(smoother.problem(track, events, sigma), earlier))
        assert all(s.minimum.convergence is Convergence.CONVERGED for s in found)
        return found

    def point(self) -> Tensor:
        """All states and coefficients, solved anew."""
        found = self.solve()
        return objective_of(found).layout.pack([s.minimum.values for s in found])

    def attached(self, method: GradientMethod, leaves: Sequence[Tensor], tolerance: float = 1e-12) -> Tensor:
        """The same, differentiable in the leaves."""
        found = self.solve()
        objective, factors = objective_of(found), factors_of(found)
        solver = ConjugateGradients(factors, objective.layout.owners(), tolerance)
        return method(
            lambda: objective.layout.pack([s.minimum.values for s in found]),
            lambda at: objective.gradient(at, self.noise.noise()),
            solver,
            leaves,
        )


def objective_of(found: Sequence[Solution]) -> BatchObjective:
    return BatchObjective([s.graph for s in found], [s.minimum.values for s in found])


def factors_of(found: Sequence[Solution]) -> GaussNewtonFactors:
    return GaussNewtonFactors([s.minimum.step.root for s in found])


def launcher() -> Launcher:
    """A launcher whose settings tell the spin of the first track, not quite right."""
    initial = torch.tensor([[5.0, 50.0, 3.0], [2.0, -4.0, 40.0]], dtype=torch.float64)
    return Launcher(SpinEmbedding(("topspin", "sidespin"), {}, initial), 15.0)


def shots(
    tracks: Sequence[Track], model: BallModel, settings: Settings = SETTINGS, surfaces: Surfaces = TABLE
) -> list[TrainingShot]:
    """Their first samples are observed, the rest predicted."""
    found = [shot for _, shot in shots_of(tracks, model, surfaces, settings, samples=OBSERVED, seconds=None)]
    assert all(isinstance(shot, TrainingShot) for shot in found)
    return found


def trainee(
    loss: LossConfig | None = None, *, model: BallModel | None = None, noise: bool = True, **options
) -> EndToEnd:
    """Three shots, the first with launcher settings, the second with a spin label; all can be learned."""
    options = {"optimizer": TIGHT} | options
    model, tells = model or usual_ball(), launcher()
    made = shots(measured(usual_ball(), STARTS, LONG), usual_ball(), replace(SETTINGS, launcher=tells))
    learnables = Learnables(model, tells.embedding, NoiseScales(NOISE, learned=noise))
    return EndToEnd(made, learnables, loss or LossConfig(), **options)


def directional(
    function: Callable[[], Tensor | float], leaves: Sequence[Tensor], directions: Sequence[Tensor], step: float
) -> float:
    """Derivative along a direction by fourth-order central differences; the leaves are put back."""
    bases, at = [leaf.detach().clone() for leaf in leaves], {}
    with torch.no_grad():
        for k in (-2, -1, 1, 2):
            for leaf, base, direction in zip(leaves, bases, directions, strict=True):
                leaf.copy_(base + k * step * direction)
            at[k] = float(function())
        for leaf, base in zip(leaves, bases, strict=True):
            leaf.copy_(base)
    return (8 * (at[1] - at[-1]) - (at[2] - at[-2])) / (12 * step)
