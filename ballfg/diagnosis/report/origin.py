"""Where a report comes from: the command that made it, its inputs, its date and the versions of the packages."""

import os
import time
from dataclasses import dataclass
from typing import Final

from ballfg.machine import versions

PACKAGES: Final = ("ballfg", "torch", "numpy", "scipy")
DATE: Final = "SOURCE_DATE_EPOCH"
"""Environment variable with a date in seconds since 1970 that stands for now, so that a page can be made again byte
for byte (reproducible-builds.org)."""


@dataclass(frozen=True)
class Origin:
    """What a report was made from, as the user typed it.

    Attributes:
        command: the command line.
        datasets: folders.
        model: the declared model's file; empty for the nominal model.
        out: folder of the report.
    """

    command: str
    datasets: tuple[str, ...]
    model: str
    out: str


def date() -> str:
    """Today, as 2026-01-31 12:00 UTC."""
    return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(float(os.environ.get(DATE, time.time()))))


def packages() -> str:
    """Versions in words."""
    return ", ".join(f"{name} {version}" for name, version in versions(PACKAGES).items())
