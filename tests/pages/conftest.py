"""A small dataset with its results."""

from pathlib import Path

import pytest

from tests.pages.made import Fall, Made, make


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    falls = {"a": Fall(), "b": Fall(0.5, (-4.0, 0.5), 70), "<script>alert(1)</script>": Fall(0.2)}
    return make(tmp_path_factory.mktemp("made"), falls)


@pytest.fixture(scope="session")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a diagnosis that added wind."""
    from ballfg.diagnosis.report.report import write_report
    from tests.diagnosis.made_diagnosis import found

    folder = tmp_path_factory.mktemp("diagnosed") / "diagnosis"
    write_report(found(), folder)
    return folder
