"""Registers the kinds of observation by name: those of the package, of the user, and of other installed packages."""

from pathlib import Path
from typing import Final

from ballfg.estimation.observations.observation import Observation
from ballfg.estimation.observations.positions import Positions
from ballfg.estimation.observations.reading import RadarSpeed, SpinReading
from ballfg.estimation.observations.sightings import CameraSightings
from ballfg.files.python_file import load_classes
from ballfg.registry import Registry

OBSERVATIONS: Final[Registry[Observation]] = Registry(
    "observation", group="ballfg.observations", base=Observation, remedy="docs/custom_factors.md has an example."
)
register_observation = OBSERVATIONS.register
"""Registers an observation, so that it is read from the folder of a dataset; may decorate the class."""
for _own in (Positions, CameraSightings, RadarSpeed, SpinReading):
    register_observation(_own)


def load_observations(path: str | Path) -> tuple[type[Observation], ...]:
    """Runs a Python file and registers its observations, except for classes whose name begins with `_`.

    Args: path: of a file that you trust: all of its code runs.
    Returns: the classes, in the order in which they stand there.
    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no Python, does not run, defines no observation, or one that cannot be registered.
    """
    return load_classes(OBSERVATIONS, path)
