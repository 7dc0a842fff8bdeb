"""The sorts of observation by name: those of the package, of the user, and of other installed packages."""

from typing import Final

from ballfg.estimation.observations.observation import Observation
from ballfg.estimation.observations.positions import Positions
from ballfg.estimation.observations.reading import RadarSpeed, SpinReading
from ballfg.estimation.observations.sightings import CameraSightings
from ballfg.registry import Registry

OBSERVATIONS: Final[Registry[Observation]] = Registry(
    "observation", group="ballfg.observations", base=Observation, remedy="docs/custom_factors.md has an example."
)
register_observation = OBSERVATIONS.register
"""Lets an observation be read from the folder of a dataset; may decorate the class."""
for _own in (Positions, CameraSightings, RadarSpeed, SpinReading):
    register_observation(_own)
