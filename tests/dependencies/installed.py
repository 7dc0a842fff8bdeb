"""What ballfg runs on: the packages that its dependencies bring, as they are installed."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from typing import Any, Final

from packaging.requirements import Requirement

from tests.places import ROOT

EXTRAS: Final = ("diffusion", "ros", "excel", "hdf5", "dask")
"""Extras that are installed for the tests; `viewer` and `ray` are not."""


def stated() -> list[Requirement]:
    """The requirements of pyproject.toml: those of every user, and those of `EXTRAS`."""
    project: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = list(project["dependencies"])
    for extra in EXTRAS:
        lines += project["optional-dependencies"][extra]
    return [Requirement(line) for line in lines]


def plain(name: str) -> str:
    """The name of a package as registries compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def installed() -> dict[str, Distribution]:
    """The stated packages and all that they need in turn, by name.

    Raises: ValueError: a stated package that is not installed.
    """
    found: dict[str, Distribution] = {}
    for requirement in stated():
        for name, package in _with_needs(requirement, set(found)):
            found[name] = package
        if plain(requirement.name) not in found:
            raise ValueError(f"{requirement.name} must be installed; it is not. Install ballfg[{','.join(EXTRAS)}].")
    return found


def _with_needs(requirement: Requirement, seen: set[str]) -> Iterator[tuple[str, Distribution]]:
    waiting = [requirement]
    while waiting:
        one = waiting.pop()
        name = plain(one.name)
        if name in seen:
            continue
        seen.add(name)
        try:
            package = distribution(one.name)
        except PackageNotFoundError:  # of another system, or of an extra of theirs
            continue
        yield name, package
        for line in package.requires or ():
            need = Requirement(line)
            if need.marker is None or any(need.marker.evaluate({"extra": extra}) for extra in ("", *one.extras)):
                waiting.append(need)
