"""Simulates the launcher tracks of the dynamics comparison, with a truth richer than any compared model.

Seven things act at once that the analytic model has not, or has with another value. Their sizes come from what is
known of spheres and from measured tracks; `EFFECTS` has them:

- Lift with the coefficient S / (1 + S) of the spin ratio S = R w / v (magnus, magnus_saturation). Its slope 1 at small
  spin, k = rho A R / (2 m) = 0.0056, is that of A. Stepanek, American Journal of Physics 56, 1988. From S = 0.2 to 2
  the acting constant falls from 0.0047 to 0.0019, as far apart as single tracks with measured spins show it.
- Drag that grows with speed (drag_speed): the standard drag curve of a smooth sphere goes from 0.40 at Re = 1e4, 4 m/s,
  to 0.47 at 3e4, 11 m/s (R. Clift, J. R. Grace, M. E. Weber, "Bubbles, Drops, and Particles", 1978, chapter 5).
- Drag that grows with spin (drag_spin): for tennis balls by half at S = 1 in a wind tunnel (Stepanek 1988), not at all
  in free flight (R. Cross, C. Lindsey, Sports Engineering 17, 2014); 0.3 lies between.
- Spin that decays (spin_decay): in still air friction takes 0.055 1/s of 240 rad/s (O. Sawatzki, Acta Mechanica 9,
  1970: torque coefficient 6.45 Re^-1/2 + 32.1 / Re with Re = w R^2 / nu); the flight adds to that.
- Restitution that falls with speed (restitution_speed): 0.93 at 3 m/s, 0.85 at 7 m/s, the range that is reported
  (A. Nakashima et al., American Control Conference 2010).
- Tangential restitution one prior standard deviation above its nominal value (tangential_restitution).
"""

from dataclasses import replace
from typing import Final

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.benchmarks.dynamics.task import Task, TaskShot
from ballfg.benchmarks.estimators.protocols import gaussian_settings
from ballfg.dynamics import BallModel, Surfaces
from ballfg.dynamics.motion.contact import contact_time
from ballfg.estimation.launcher import Launcher
from ballfg.factors.noise import ProcessNoise
from ballfg.prediction.apexes import true_apexes
from ballfg.progress import progress
from ballfg.simulation import MeasurementNoise, SimulationConfig, parse_effects, simulate, table_tennis
from ballfg.simulation.motion import true_model
from ballfg.simulation.synthetic import SimulatedTrack, dataset_info
from ballfg.state import POSITION, VZ

CASE: Final = "synthetic"
TRACKS: Final = 717  # As in the paper
TRAIN_SHARE: Final = 0.8  # Share of tracks for training: 573 of 717; 144 judge
RATE: Final = 120.0  # Hz
NOISE: Final = 0.003  # m, of each measured coordinate
MOST_SAMPLES: Final = 300  # Longest track; as many points as the paper predicts at once
MOST_BOUNCES: Final = 3  # A track ends before the next one: the paper's tracks bounce once to three times
OBSERVED: Final = 80  # Samples that a model is given; as in the paper
LABEL_NOISE: Final = 4.0
"""rad/s per axis, of the spin that `Launcher` reads off the settings: the spins of the launches spread by 3, and
the direction of flight, taken from noisy samples, adds to that. The root mean square of the labels' errors is 3.9."""
EFFECTS: Final = (
    "magnus.k=0.0056",
    "magnus_saturation.strength=1",
    "drag_speed.slope=0.025",
    "drag_spin.gain=0.3",
    "spin_decay.rate=0.1",
    "restitution_speed.slope=0.02",
    "tangential_restitution.e_t=0.25",
)
"""Effects that act although no compared model declares them, or declares another value."""
_SPLIT_STREAM: Final = 6  # Keeps the draw of the split apart from other draws of the same seed


def synthetic_task(seed: int, tracks: int = TRACKS) -> Task:
    """Synthetic tracks with their truth; the seed decides launches, noise and split."""
    kind = table_tennis()
    config = SimulationConfig(
        tracks=tracks,
        rate=RATE,
        seed=seed,
        ball=replace(kind, launcher=kind.launcher.with_fields({"duration": (MOST_SAMPLES - 1) / RATE})),
        noise=MeasurementNoise(position=NOISE),
        undeclared=parse_effects(EFFECTS),
        spin_labels=False,  # launcher settings are the labels
    )
    model = true_model(kind.model, config.undeclared)
    shots = [true_shot(made, model, kind.surfaces) for made in progress(simulate(config), tracks, "tracks simulated")]
    train, validation = split(len(shots), seed)
    return Task(
        case=CASE,
        info=replace(dataset_info(config), name=CASE),
        # the tracks end where a ball falls beside the table, so that no model needs its edges
        surfaces=Surfaces.table_tennis(kind.surfaces.table_height),
        settings=gaussian_settings(NOISE, ProcessNoise(), LABEL_NOISE),
        launcher=Launcher.of_levels(kind.launcher.topspin_scale, kind.launcher.sidespin_scale, LABEL_NOISE),
        launcher_labels=("topspin", "sidespin"),
        observe={"samples": OBSERVED},
        truth=model,
        train=tuple(shots[i] for i in train),
        validation=tuple(shots[i] for i in validation),
    )


def split(count: int, seed: int) -> tuple[list[int], list[int]]:
    """Numbers of the tracks to train on and of those to judge by, each in order."""
    order = np.random.default_rng([seed, _SPLIT_STREAM]).permutation(count)
    fitted = min(max(int(TRAIN_SHARE * count), 1), count - 1)
    return sorted(order[:fitted].tolist()), sorted(order[fitted:].tolist())


def true_shot(made: SimulatedTrack, model: BallModel, surfaces: Surfaces) -> TaskShot:
    """A simulated track up to its fourth bounce, with bounces and apexes of the true motion."""
    bounces = true_bounces(made.true_times, made.true_states, model, surfaces)
    keep = np.ones(len(made.track), dtype=bool)
    if len(bounces) > MOST_BOUNCES:
        keep = made.true_times < bounces[MOST_BOUNCES]
    times, states = made.true_times[keep], made.true_states[keep]
    track = replace(made.track, times=made.track.times[keep], positions=made.track.positions[keep])
    apexes, apex_times = true_apexes(times, states, bounces)
    return TaskShot(
        track=track,
        reference=states[:, POSITION],
        observed=min(OBSERVED, len(track)),
        judged=len(track),
        bounces=bounces[:MOST_BOUNCES],
        apexes=apexes,
        apex_times=apex_times,
        states=states,
    )


@torch.no_grad()
def true_bounces(times: Array, states: Array, model: BallModel, surfaces: Surfaces) -> Array:
    """(b,) s, the contacts of a true motion (n, 9), by flying each state before a bounce on to the surface."""
    rows = np.flatnonzero((states[:-1, VZ] < 0.0) & (states[1:, VZ] > 0.0))
    before = torch.from_numpy(states[rows])
    tau = contact_time(model, before, surfaces.height_below(before, model.surface_offset(before))).numpy()
    dt = times[rows + 1] - times[rows]
    touches = (tau >= 0.0) & (tau <= dt)  # a strong lift can turn a fall upwards without any contact
    return np.asarray(times[rows][touches] + tau[touches])
