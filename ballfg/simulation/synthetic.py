"""Simulates tracks one after the other, in blocks of bounded size: the true motion, then noise and outliers."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ballfg.arrays import Array
from ballfg.checks import check_instance
from ballfg.dynamics import AnalyticModel, BallModel
from ballfg.dynamics.motion.rollout import advance
from ballfg.simulation.config import MeasurementNoise, SimulationConfig
from ballfg.simulation.motion import KickedModel, TrueMotion, simulate_motion, true_model
from ballfg.simulation.settings import SETTING_LEVELS, Settings, settings_of_shots
from ballfg.simulation.streams import Purpose, cut_normal, generator
from ballfg.state import POSITION, SPIN
from ballfg.tracks import Track
from ballfg.tracks.info import DatasetInfo
from ballfg.tracks.track import SPIN_LABELS

LEAST_SAMPLES = 2  # Least number of samples in a track: readers refuse shorter ones


@dataclass(frozen=True, eq=False)
class SimulatedTrack:
    """A measured track with its true states."""

    track: Track  # Stamps, positions and labels with all their noise
    true_times: Array  # (n,) s, true times of the frames
    true_states: Array  # (n, 9) the ball's state at those times


@torch.no_grad()
def measure(
    config: SimulationConfig, model: BallModel, motion: TrueMotion, settings: Settings, block: int, first: int
) -> list[SimulatedTrack]:
    """The tracks of a block of shots.

    Args:
        model: the true ball without random kicks, with its measurement effects.  motion: (n, k) true frames.
        settings: (n, 3) of the launcher.  block: number of the block, which picks the random streams.
        first: number of its first shot, for the names.
    """
    noise, shape = config.noise, motion.states.shape[:2]
    frames = np.arange(shape[1])
    exists = frames < motion.lengths[:, None]
    kept = exists & _kept_frames(noise, config.seed, block, exists)
    true_times = frames / config.rate
    jitter = noise.jitter * cut_normal(generator(config.seed, Purpose.JITTER, block), shape)
    stamps = model.stamps(torch.from_numpy(true_times)).numpy() + jitter
    positions = _apparent_positions(config, model, motion.states, exists)
    positions += _position_noise(noise, config.seed, block, shape)
    positions += _lasting_errors(noise, config.rate, config.seed, block, shape)
    label_noise = noise.spin * generator(config.seed, Purpose.LABEL, block).standard_normal((shape[0], 3))
    width = max(3, len(str(config.tracks - 1)))
    tracks = []
    for i, keep in enumerate(kept):
        states = motion.states[i, keep]
        labels = dict(zip(SETTING_LEVELS, settings[i].astype(float).tolist(), strict=True))
        if config.spin_labels:
            spin = model.labelled(torch.from_numpy(states[0, SPIN])).numpy() + label_noise[i]
            labels = dict(zip(SPIN_LABELS, spin.tolist(), strict=True)) | labels
        track = Track(stamps[i, keep], positions[i, keep], labels=labels, name=f"{first + i:0{width}d}")
        tracks.append(SimulatedTrack(track, true_times[keep], states))
    return tracks


def _kept_frames(noise: MeasurementNoise, seed: int, block: int, exists: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(n, k) bool: the frame was not dropped. At least two frames of a track stay, whatever the dropout."""
    luck = generator(seed, Purpose.DROPOUT, block).random(exists.shape)
    kept = luck >= noise.dropout
    order = np.argsort(np.where(exists, -luck, 1.0), axis=1)
    np.put_along_axis(kept, order[:, :LEAST_SAMPLES], True, axis=1)
    return kept


def _position_noise(noise: MeasurementNoise, seed: int, block: int, shape: tuple[int, ...]) -> Array:
    """(n, k, 3) m, Gaussian noise and outliers."""
    added = noise.position * generator(seed, Purpose.POSITION, block).standard_normal((*shape, 3))
    rng = generator(seed, Purpose.OUTLIER, block)
    is_outlier = rng.random(shape) < noise.outliers
    direction = rng.standard_normal((*shape, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    distance = noise.outlier_size * rng.uniform(0.5, 1.5, shape)
    return added + np.where(is_outlier, distance, 0.0)[..., None] * direction


def _lasting_errors(noise: MeasurementNoise, rate: float, seed: int, block: int, shape: tuple[int, ...]) -> Array:
    """(n, k, 3) m, errors with exponentially decaying correlation, on all frames, kept or dropped."""
    if noise.memory == 0.0:
        return np.zeros((*shape, 3))
    errors = noise.memory * generator(seed, Purpose.MEMORY, block).standard_normal((*shape, 3))
    kept = np.exp(-1.0 / (rate * noise.memory_time))
    for k in range(1, shape[1]):
        errors[:, k] = kept * errors[:, k - 1] + np.sqrt(1.0 - kept**2) * errors[:, k]
    return np.asarray(errors)


def _apparent_positions(config: SimulationConfig, model: BallModel, states: Array, exists: NDArray[np.bool_]) -> Array:
    """(n, k, 3) m, measured positions before noise."""
    apparent, flat = states[..., POSITION].copy(), torch.from_numpy(states[exists])

    def later(delay: Tensor) -> Tensor:
        return advance(model, flat, delay.expand(len(flat)), config.ball.surfaces)

    apparent[exists] = model.measured(flat, later).numpy()
    return apparent


def simulate(config: SimulationConfig) -> Iterator[SimulatedTrack]:
    """Simulates tracks, with their truth.

    Memory is that of one block, whatever the number of tracks.

    Returns: an iterator over the tracks in the order of their names, "000", "001" ...
    Raises: ValueError: at once, if an undeclared effect does not fit the model.
    """
    check_instance("config", config, SimulationConfig, "Make one with SimulationConfig(tracks=10).")
    model = true_model(config.ball.model, config.undeclared)
    starts = range(0, config.tracks, config.block)
    return itertools.chain.from_iterable(_block(config, model, block, first) for block, first in enumerate(starts))


def _block(config: SimulationConfig, model: AnalyticModel, block: int, first: int) -> list[SimulatedTrack]:
    kind, noise = config.ball, config.process
    launching, moving, kicking = (
        generator(config.seed, purpose, block) for purpose in (Purpose.LAUNCH, Purpose.PROCESS, Purpose.CONTACT)
    )
    settings = settings_of_shots(config.combinations(), first, min(config.block, config.tracks - first), config.seed)
    start = kind.launcher.launch(settings, kind.surfaces.table_height, launching)
    ball: BallModel = KickedModel(model, noise, kicking) if noise.in_contact else model
    motion = simulate_motion(ball, start, config.rate, kind.surfaces, kind.launcher, noise, moving)
    return measure(config, model, motion, settings, block, first)


def dataset_info(config: SimulationConfig) -> DatasetInfo:
    """The content of `dataset.yaml`: the declared noise, without undeclared effects."""
    noise = config.noise
    return DatasetInfo(
        name=f"simulated {config.ball.name}",
        table_height=config.ball.surfaces.table_height,
        ball=config.ball.ball,
        rate=config.rate,
        position_noise=noise.position or None,
        spin_noise=(noise.spin or None) if config.spin_labels else None,
        source="ballfg simulate",
        table_extent=config.ball.surfaces.extent,
    )
