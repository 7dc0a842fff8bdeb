"""Simulates tracks one after the other, in blocks of bounded size."""

import itertools
from collections.abc import Iterator

from ballfg.checks import check_instance
from ballfg.dynamics import AnalyticModel, BallModel
from ballfg.simulation.config import SimulationConfig
from ballfg.simulation.measure import SimulatedTrack, measure
from ballfg.simulation.motion import KickedModel, simulate_motion, true_model
from ballfg.simulation.settings import settings_of_shots
from ballfg.simulation.streams import Purpose, generator
from ballfg.tracks.info import DatasetInfo


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
