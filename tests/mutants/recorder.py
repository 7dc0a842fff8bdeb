"""A plugin of pytest that keeps which test reaches which lines, and how long each test takes.

`-p tests.mutants.recorder` with the folder in `BALLFG_RECORD`; every process of pytest-xdist writes files of its own.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import coverage
import pytest

from tests.mutants.sources import PACKAGES
from tests.places import ROOT

FOLDER: Final = "BALLFG_RECORD"
SETUP: Final = "|setup"
"""Stands behind a test's name where the lines were reached before the test began, in what it asks for."""


class Recorder:
    """Counts lines and time, test by test."""

    def __init__(self, folder: Path, process: str) -> None:
        self.folder, self.process = folder, process
        self.tests: dict[str, dict[str, object]] = {}
        self.coverage = coverage.Coverage(
            data_file=str(folder / f"lines.{process}"),
            config_file=False,
            source=[str(ROOT / package) for package in PACKAGES],
            messages=False,
        )
        self.coverage.set_option(
            "run:disable_warnings", ["already-imported", "no-data-collected", "module-not-measured"]
        )
        self.coverage.start()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> Iterator[None]:
        self.coverage.switch_context(item.nodeid + SETUP)
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Iterator[None]:
        self.coverage.switch_context(item.nodeid)
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_teardown(self, item: pytest.Item) -> Iterator[None]:
        self.coverage.switch_context("")
        return (yield)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        test = self.tests.setdefault(report.nodeid, {"seconds": 0.0, "passed": True})
        test["seconds"] = round(float(test["seconds"]) + report.duration, 3)  # type: ignore[arg-type]
        test["passed"] = bool(test["passed"]) and report.outcome == "passed"

    def pytest_sessionfinish(self) -> None:
        self.coverage.stop()
        self.coverage.save()
        (self.folder / f"tests.{self.process}.json").write_text(json.dumps(self.tests), encoding="utf-8")


def pytest_configure(config: pytest.Config) -> None:
    """Record in the processes that run tests: with pytest-xdist not in the one that hands them out."""
    worker = getattr(config, "workerinput", None)
    if worker is None and config.getoption("numprocesses", None):
        return
    name = "main" if worker is None else worker["workerid"]
    config.pluginmanager.register(Recorder(Path(os.environ[FOLDER]), name))
