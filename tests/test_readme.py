"""The README's first estimate runs as it stands there, and the files that the documents link to exist."""

import re
from pathlib import Path

import pytest

from tests.tutorials import run_document

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
DOCUMENTS = [README, *sorted((ROOT / "docs").rglob("*.md"))]


def first_python() -> str:
    """The code of the first estimate, after the word `python` of its fence."""
    text = README.read_text(encoding="utf-8")
    return text[text.index("```python\n") :].split("```")[1]


def test_the_first_estimate_runs_as_it_stands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = first_python()
    assert len([line for line in code.splitlines()[1:] if line.strip()]) <= 15
    monkeypatch.chdir(tmp_path)
    printed = run_document(f"```\nballfg example\n```\n```{code}```\n```text\n```\n")
    assert "converged\n" in printed
    assert re.search(r"bounces at 0\.\d{3} s \+- \d+\.\d ms, x = ", printed)


@pytest.mark.thorough
def test_every_block_runs_as_it_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """From top to bottom in one folder; but for the installation, which has taken place, and `ballfg compile`."""
    text, code = README.read_text(encoding="utf-8"), first_python()
    setup = text[text.index("```\npython3 -m venv") : text.index("## The first ten minutes")]
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
