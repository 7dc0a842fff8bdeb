"""The machine and the installed packages, as results and runs record them."""

import os
import platform
from collections.abc import Iterable
from importlib import metadata


def usable_cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Versions of Python and of installed packages, by name."""
    return {"python": platform.python_version()} | {name: metadata.version(name) for name in packages}
