"""The README's first estimate runs as it stands there, and the files that the documents link to exist."""

import re
from pathlib import Path

import pytest

from tests.tutorials import run_document

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def test_every_block_runs_as_it_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """From top to bottom in one folder; but for the installation, which has taken place, and `ballfg compile`."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    setup = text[text.index("```\npython3 -m venv") : text.index("## The first ten minutes")]
    code = text[text.index("```python\n") :].split("```")[1]
    assert len([line for line in code.splitlines()[1:] if line.strip()]) <= 15
    monkeypatch.chdir(tmp_path)
    run_document(
        text.replace(setup, "").replace(code, f"{code}printed = [estimate.status.value, bounce.time]\nprint(printed)\n")
    )
    capsys.readouterr()
    for name in ("page.html", "diagnosis/report.html", "better.csv", "mine/import.html", "live.jsonl", "by_mine.csv"):
        assert (tmp_path / name).stat().st_size > 1000, name
    for name in ("next_shots.csv", "from_pixels.csv", "mine_states.csv"):
        assert (tmp_path / name).is_file(), name


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(document: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", document.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (document.parent / target).exists(), f"{document.name} links to {target}, which is not there"


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_named_in_documents_exist(document: Path) -> None:
    """Such as `tests/tracks/test_reading.py` beside a promise."""
    paths = re.findall(
        r"`((?:tests|ballfg|benchmarks|factors|learning)/[\w./]+\.py)`", document.read_text(encoding="utf-8")
    )
    assert [path for path in paths if not (ROOT / path).exists()] == []
