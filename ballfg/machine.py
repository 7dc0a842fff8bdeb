"""The machine and the installed packages, as results and runs record them."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterable
from importlib import metadata
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    import torch

DATE: Final = "SOURCE_DATE_EPOCH"
"""Environment variable with a date in seconds since 1970 that stands for now, so that a page can be made again byte
for byte (reproducible-builds.org)."""


def usable_cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Versions of Python and of installed packages, by name."""
    return {"python": platform.python_version()} | {name: metadata.version(name) for name in packages}


def usable_device(name: str) -> torch.device:
    """A torch device by its name.

    Raises: ValueError: if torch cannot compute on it.
    """
    import torch

    try:
        device = torch.device(name)
        torch.zeros(1, dtype=torch.float64, device=device).cpu()
    # torch's, for all that it cannot use
    except (RuntimeError, AssertionError, NotImplementedError, TypeError, ValueError) as error:
        reason, got = str(error).splitlines()[0], " ".join(repr(name)[:80].split())
        raise ValueError(f"device must be one that torch computes on; got {got}: {reason}") from None
    return device


def date() -> str:
    """Today, as 2026-01-31 12:00 UTC."""
    return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(float(os.environ.get(DATE, time.time()))))
