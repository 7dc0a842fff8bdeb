"""Lower bounds that are held, licences that are judged, and an audit that says when it did not happen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

from tests.dependencies.audit import report
from tests.dependencies.installed import installed, plain, stated
from tests.dependencies.licences import GPU, is_allowed, licence_of
from tests.places import ROOT


def test_the_oldest_versions_are_the_lower_bounds() -> None:
    """`make check-oldest` installs exactly what pyproject.toml says is old enough."""
    lines = (ROOT / "constraints-oldest.txt").read_text(encoding="utf-8").splitlines()
    pins = {plain(one.name): one.specifier for one in map(Requirement, filter(lambda line: line[:1] != "#", lines))}
    bounds = {plain(one.name): one.specifier for one in stated()}
    assert pins.keys() == bounds.keys()
    for name, bound in bounds.items():
        (least,), (pin,) = bound, pins[name]
        assert (least.operator, pin.operator) == (">=", "=="), name
        assert Version(least.version) == Version(pin.version), name


def test_every_licence_is_allowed() -> None:
    packages = installed()
    assert {"torch", "gtsam", "numpy", "pyyaml"} <= packages.keys()
    wrong = {name: licence_of(one) for name, one in packages.items() if not is_allowed(licence_of(one))}
    assert {name: licence for name, licence in wrong.items() if not name.startswith(GPU)} == {}


@pytest.mark.parametrize(
    ("licence", "allowed"),
    [
        ("MIT", True),
        ("GPL-3.0-only AND (MIT OR Apache-2.0)", False),  # brackets are for a person to read
        ("Apache-2.0 OR GPL-3.0-only", True),
        ("GPL-3.0-only", False),
        ("MIT AND AGPL-3.0-only", False),
        ("", False),
    ],
)
def test_licences_are_judged(licence: str, allowed: bool) -> None:
    assert is_allowed(licence) is allowed


GOOD = {"name": "a", "version": "1", "vulns": []}
SKIPPED = {"name": "b", "skip_reason": "not found"}
BAD = {"name": "c", "version": "2", "vulns": [{"id": "CVE-1", "fix_versions": ["3"]}]}


@pytest.mark.parametrize(
    ("judged", "count", "strict", "status", "words"),
    [
        ([GOOD], 1, True, 0, "1 of 1 packages audited"),
        ([GOOD, SKIPPED], 2, False, 0, "AUDIT SKIPPED for 1 packages: not found"),
        ([GOOD, SKIPPED], 2, True, 1, "AUDIT SKIPPED for 1 packages"),
        ([], 2, False, 0, "AUDIT SKIPPED for 2 packages: no network"),
        ([GOOD, BAD], 2, False, 1, "VULNERABLE c 2: CVE-1, mended in 3"),
    ],
)
def test_an_audit_says_what_it_did_not_do(
    judged: list[Mapping[str, Any]],
    count: int,
    strict: bool,
    status: int,
    words: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert report(judged, count, "" if judged else "no network", strict=strict) == status
    assert words in capsys.readouterr().out
