"""A user's file runs as a whole, leaves no module behind, and is blamed by its line."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from ballfg import interrupts
from ballfg.files.python_file import run_file


def test_a_file_runs_and_leaves_no_module_behind(tmp_path: Path) -> None:
    path = tmp_path / "own.py"
    path.write_text(
        "from dataclasses import dataclass\n@dataclass\nclass Ball:\n    radius: float\nhalf = Ball(0.04).radius / 2\n"
    )
    before = set(sys.modules)
    module = run_file(path, "effects")
    assert module.half == 0.02
    assert module.__name__ == f"ballfg effects {path}"
    assert set(sys.modules) == before


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("x = 1\ny = x / 0\n", 2),
        ("x = 1\n\nx = (\n", 3),
        ("import sys\nsys.exit(3)\n", 2),
        ("\nraise GeneratorExit\n", 2),
        ("class Odd(BaseException): ...\nraise Odd\n", 2),
    ],
)
def test_what_a_file_raises_is_one_line_with_its_place(tmp_path: Path, text: str, line: int) -> None:
    path = tmp_path / "own.py"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"own\.py must run as Python; .*line {line}.*Mend it there\.$") as raised:
        run_file(path, "effects")
    assert "\n" not in str(raised.value)
    assert not any(name.startswith("ballfg effects") for name in sys.modules)


def test_an_interrupt_while_a_file_runs_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "own.py"
    path.write_text("raise KeyboardInterrupt\n")
    monkeypatch.setattr(interrupts, "_listening", True)
    with pytest.raises(ValueError, match=r"line 1: KeyboardInterrupt"):  # its own: no signal has come
        run_file(path, "effects")
    monkeypatch.setattr(interrupts, "_number", 2)
    with pytest.raises(KeyboardInterrupt):
        run_file(path, "effects")
