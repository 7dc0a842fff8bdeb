"""The tutorials run from top to bottom and print what stands in them."""

from pathlib import Path

import pytest

from tests.tutorials import TUTORIALS, run_document

LONG = ("4_train", "5_what_is_missing", "6_the_papers_comparison")


@pytest.mark.parametrize(
    "document",
    [pytest.param(path, marks=[pytest.mark.thorough] * (path.stem in LONG), id=path.stem) for path in TUTORIALS],
)
def test_runs_as_it_stands(document: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    text = document.read_text(encoding="utf-8")
    assert "```text\n" in text
    assert run_document(text) == text


def test_a_command_that_fails_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RuntimeError, match="status 2"):
        run_document("```\nballfg estimate nothing --out states.csv\n```\n")
    assert (
        run_document("```python\nprint(1)\n```\n\n```text\n2\n```\n") == "```python\nprint(1)\n```\n\n```text\n1\n```\n"
    )
