"""Compares the versions of two processes' packages, so that they compute the same."""

import hashlib
import os
from functools import cache
from pathlib import Path

from ballfg.machine import versions

PACKAGES = ("ballfg", "torch", "numpy", "scipy", "numba", "gtsam")  # packages whose version may change a result
SOURCE = "source of ballfg"  # name of the digest of ballfg's own files: a checkout may change without its version
HERE = (
    "dict(__import__('ballfg.parallel.same_versions', fromlist=['own_versions']).own_versions()) "
    "if (find := __import__('importlib.util').util.find_spec)('ballfg') and find('ballfg.parallel') else {}"
)
"""Python expression for the versions of a worker, none without ballfg; it uses nothing but Python."""


@cache
def own_versions() -> dict[str, str]:
    """The versions of this process, and a digest of ballfg's source, by name."""
    found = versions(PACKAGES)
    found["python"] = ".".join(found["python"].split(".")[:2])
    return found | {SOURCE: _digest(Path(__file__).parents[1])}


def differences(theirs: dict[str, str], whose: str = "a worker") -> str | None:
    """A message on versions of a process, `whose`, that differ from those of this one; None without any."""
    own = own_versions()
    if theirs == own:
        return None
    if not theirs:
        return f"{whose} must be able to import ballfg; it cannot. Install ballfg {own['ballfg']} there."
    names = [name for name in own | theirs if theirs.get(name) != own.get(name)]
    listed = ", ".join(f"{name} {own.get(name, 'none')} and {theirs.get(name, 'none')}" for name in names)
    return f"{whose} must have the versions of the process that sends work; got {listed}. Install the same versions."


def _digest(folder: Path) -> str:
    found = hashlib.sha256()
    for path, folders, files in os.walk(folder, followlinks=True):
        folders.sort()
        for file in sorted(name for name in files if name.endswith(".py")):
            found.update(str(Path(path, file).relative_to(folder)).encode())
            found.update(Path(path, file).read_bytes())
    return found.hexdigest()[:12]
