"""Records the origin of a report: its command, its inputs, and the versions of the packages."""

from dataclasses import dataclass
from typing import Final

from ballfg.machine import versions

PACKAGES: Final = ("ballfg", "torch", "numpy", "scipy")


@dataclass(frozen=True)
class Origin:
    """The inputs of a report, as the user typed them: command line, folders of the datasets, files."""

    command: str
    datasets: tuple[str, ...]
    model: str  # the declared model's file; empty for the nominal model
    out: str
    models: tuple[str, ...] = ("model.yaml",)
    """File of the corrected model of each dataset, in the folder `out` of the report."""
    doubts: tuple[str, ...] = ()  # what is not sure about the tracks


def packages() -> str:
    """Versions in words."""
    return ", ".join(f"{name} {version}" for name, version in versions(PACKAGES).items())
