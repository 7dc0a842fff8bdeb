"""Spin labels of simulated sets whose flights and bounces scatter: which of them does a diagnosis call wrong?

The sets are of the world that `Settings.for_measured` describes, or of one that scatters less: process noise in flight
and at bounces, and coefficients that differ from track to track. Labels are right to the stated 4 rad/s; in other sets
a fifth of them is wrong. `python -m tests.diagnosis.right_labels --sets 60 --wrong-sets 20 --seed 5000` prints the sets
in which a right label is called wrong, the share of wrong labels that are found, and that of right ones beside them.
Labels are judged about the fit of the declared model, as by a diagnosis that adds no effect; `--whole` runs all of it.
"""

from __future__ import annotations

import argparse
import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from ballfg.diagnosis import check_labels, diagnose, fit_model, hold_out
from ballfg.diagnosis.generic_test import LabelCheck
from ballfg.diagnosis.search.evaluation import calibrated_model
from ballfg.dynamics import nominal_model
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.coefficient import coefficient_sigmas
from ballfg.dynamics.motion.rollout import advance
from ballfg.estimation.settings import MEASURED
from ballfg.simulation import SimulationConfig
from ballfg.simulation.config import MeasurementNoise, MotionNoise
from ballfg.simulation.motion import MIN_FRAMES, NOISE_STEP, KickedModel, TrueMotion, process_noise
from ballfg.simulation.settings import settings_of_shots
from ballfg.simulation.synthetic import dataset_info, measure
from ballfg.state import STATE_DIM
from ballfg.tracks import Dataset, Track
from ballfg.tracks.dataset import dataset_in_memory
from ballfg.tracks.track import SPIN_LABELS

TRACKS, RATE, NOISE, LABEL_NOISE = 25, 100.0, 0.002, 4.0
SIZES = (0.25, 0.5, 1.0)
"""Of the scatter, as shares of that of `Settings.for_measured`."""
WRONG, OFF = 0.2, 100.0
"""Share of the labels that are wrong in some sets, and by how much, rad/s, in any direction."""


class ScatteringBounces(KickedModel):
    """A model whose bounces scatter as `MEASURED` says, times a size: more along the surface than off it."""

    def __init__(self, model: AugmentedModel, size: float, rng: np.random.Generator) -> None:
        super().__init__(model, MotionNoise(), rng)
        along = np.hypot(MEASURED.contact_velocity, MEASURED.contact_tangential)
        kick = (0.0, 0.0, 0.0, along, along, MEASURED.contact_velocity, *(MEASURED.contact_spin,) * 3)
        self._sigma = size * torch.tensor((*kick, *(0.0,) * model.width), dtype=torch.float64)


@torch.no_grad()
def scattering_set(seed: int, size: float, wrong: float = 0.0, tracks: int = TRACKS) -> tuple[Dataset, set[str]]:
    """Tracks in a world that scatters, and the names of those whose labels are wrong.

    Args: seed: of all random numbers.  size: of the scatter.  wrong: share of labels that are wrong.  tracks: number.
    """
    model = nominal_model("table_tennis").requires_grad_(False)
    config = SimulationConfig(
        tracks=tracks,
        rate=RATE,
        seed=seed,
        noise=MeasurementNoise(position=NOISE, spin=LABEL_NOISE),
        process=MotionNoise(acceleration=size * MEASURED.acceleration, spin=size * MEASURED.spin),
    )
    rng, ball, sigmas = np.random.default_rng([seed, 41]), config.ball, coefficient_sigmas(model)
    settings = settings_of_shots(config.combinations(), 0, tracks, seed)
    launches = ball.launcher.launch(settings, ball.surfaces.table_height, rng)
    own = AugmentedModel(model, tuple(sigmas))  # each track has coefficients of its own
    spread = size * torch.tensor(list(sigmas.values())) * torch.from_numpy(rng.standard_normal((tracks, len(sigmas))))
    moving = ScatteringBounces(own, size, rng)
    motion = _flown(moving, torch.cat((launches, own.means() + spread), dim=-1), config, rng)
    made = [simulated.track for simulated in measure(config, model, motion, settings, 0, 0)]
    chosen = rng.choice(tracks, round(wrong * tracks), replace=False).tolist()
    for i in chosen:
        made[i] = _with_wrong_label(made[i], rng)
    return dataset_in_memory(dataset_info(config), made), {made[i].name for i in chosen}


def _flown(moving: ScatteringBounces, state: Tensor, config: SimulationConfig, rng: np.random.Generator) -> TrueMotion:
    """The motion of balls (n, 9 + p), with process noise, until they leave the launcher's view."""
    launcher, surfaces = config.ball.launcher, config.ball.surfaces
    steps = math.ceil(1.0 / RATE / NOISE_STEP)
    h, frames = 1.0 / RATE / steps, [state]
    for _ in range(math.floor(launcher.duration * RATE)):
        for _ in range(steps):
            state = advance(moving, state, torch.full((len(state),), h, dtype=torch.float64), surfaces)
            state[:, :STATE_DIM] += process_noise(len(state), h, config.process, rng)
        frames.append(state)
    states = torch.stack(frames, dim=1)
    seen = launcher.in_view(states, surfaces, moving) | (torch.arange(len(frames)) < MIN_FRAMES)
    return TrueMotion(states[..., :STATE_DIM].numpy(), seen.cumprod(dim=1).sum(dim=1).numpy())


def _with_wrong_label(track: Track, rng: np.random.Generator) -> Track:
    way = rng.standard_normal(3)
    assert track.spin_label is not None
    label = track.spin_label + OFF * way / np.linalg.norm(way)
    return replace(track, labels={**track.labels, **dict(zip(SPIN_LABELS, label.tolist(), strict=True))})


@dataclass
class Tally:
    """What was called wrong: sets, labels that are wrong, labels that are right.

    Attributes:
        sets, accusing: sets without a wrong label, and those of them in which one was called wrong.
        wrong, found: labels that are wrong, and those called so.
        right, accused: labels that are right in sets with wrong ones, and those called wrong.
        effects: sets without a wrong label in which an effect of all spin labels was named.
    """

    sets: int = 0
    accusing: int = 0
    wrong: int = 0
    found: int = 0
    right: int = 0
    accused: int = 0
    effects: int = 0

    def add(self, contradicted: set[str], bad: set[str], effects: tuple[str, ...], tracks: int) -> None:
        """Count a set: tracks whose labels were called wrong, those that are, effects that were named."""
        if not bad:
            self.sets += 1
            self.accusing += bool(contradicted)
            self.effects += any(name.startswith("spin_label") for name in effects)
            return
        self.wrong += len(bad)
        self.found += len(bad & contradicted)
        self.right += tracks - len(bad)
        self.accused += len(contradicted - bad)

    def __str__(self) -> str:
        clean = f"{self.accusing} of {self.sets} sets with right labels accuse one" if self.sets else ""
        clean += f" ({self.effects} name an effect of all labels)" if self.effects else ""
        mixed = (
            f"{self.found} of {self.wrong} wrong labels found ({100 * self.found / self.wrong:.0f} %), "
            f"{self.accused} of {self.right} right ones beside them accused ({100 * self.accused / self.right:.1f} %)"
            if self.wrong
            else ""
        )
        return "; ".join(part for part in (clean, mixed) if part)


def judged(dataset: Dataset, *, whole: bool) -> tuple[LabelCheck, tuple[str, ...]]:
    """What is said of the labels, and the effects that are named; `whole` for the whole diagnosis, which names some."""
    model = nominal_model("table_tennis")
    if whole:
        found = diagnose(dataset, model)
        assert found.labels is not None
        return found.labels, tuple(finding.name for finding in found.findings)
    holdout = hold_out(dataset, model)
    fit = fit_model(model, holdout.search, holdout.settings)
    labels = check_labels(calibrated_model(fit, holdout.launcher.embedding), model, holdout)
    assert labels is not None
    return labels, ()


@dataclass
class Sets:
    """The sets of one run: `clean` ones without a wrong label, `mixed` ones with; sizes of the scatter take turns."""

    clean: int
    mixed: int
    seed: int
    whole: bool
    tallies: dict[float, Tally] = field(default_factory=lambda: {size: Tally() for size in SIZES})

    def run(self) -> Iterator[str]:
        """Diagnose all sets; a line for each."""
        for k in range(self.clean + self.mixed):
            size, wrong = SIZES[k % len(SIZES)], 0.0 if k < self.clean else WRONG
            dataset, bad = scattering_set(self.seed + k, size, wrong)
            labels, effects = judged(dataset, whole=self.whole)
            contradicted = {verdict.track for verdict in labels.contradicted}
            self.tallies[size].add(contradicted, bad, effects, len(dataset))
            yield (
                f"seed {self.seed + k}, size {size:g}: accused {sorted(contradicted)}, wrong {sorted(bad)}, "
                f"p_all_right {labels.p_all_right:.2g}, {len(labels.verdicts)} judged, effects {effects}"
            )


def summed(tallies: dict[float, Tally]) -> Tally:
    """The counts of all sizes."""
    total = Tally()
    for tally in tallies.values():
        for name, count in vars(tally).items():
            setattr(total, name, getattr(total, name) + count)
    return total


def main() -> None:
    """Print the counts by size of the scatter, and of all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=60, help="sets with right labels")
    parser.add_argument("--wrong-sets", type=int, default=20, help="sets in which a fifth of the labels is wrong")
    parser.add_argument("--seed", type=int, default=5000, help="of the first set")
    parser.add_argument("--whole", action="store_true", help="run the whole diagnosis, which takes three times as long")
    given = parser.parse_args()
    warnings.filterwarnings("ignore", category=DeprecationWarning)  # of torch
    sets = Sets(given.sets, given.wrong_sets, given.seed, given.whole)
    for line in sets.run():
        print(line, flush=True)
    for size, tally in sets.tallies.items():
        print(f"scatter times {size:g}: {tally}")
    print(f"all: {summed(sets.tallies)}")


if __name__ == "__main__":
    main()
