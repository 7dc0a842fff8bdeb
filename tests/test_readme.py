"""The README's first estimate runs as it stands there, and the files that the documents link to exist."""

import re
from pathlib import Path

import pytest

from ballfg.cli.main import run

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def test_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    command, code = re.findall(r"```\nballfg (simulate [^\n]*)\n```\n\n```python\n(.*?)```", text, flags=re.DOTALL)[0]
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="0"):
        run(command.split())
    capsys.readouterr()
    assert len([line for line in code.splitlines() if line.strip()]) <= 15
    exec(compile(code, "README.md", "exec"), {"__name__": "readme"})
    printed = capsys.readouterr().out
    assert printed.startswith("converged")
    assert "BallState(t = 0.2500 s" in printed
    bounce = re.search(r"bounces at (\d+\.\d+) s", printed)
    assert bounce is not None
    assert 0.2 < float(bounce[1]) < 1.0


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(document: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", document.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (document.parent / target).exists(), f"{document.name} links to {target}, which is not there"
