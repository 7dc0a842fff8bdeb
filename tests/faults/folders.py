"""A folder as commands write it, without a command: quick enough to be killed at every call."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ballfg.files.whole_folder import whole_folder
from tests.faults.kills import Scenario


def nothing(folder: Path) -> None:
    """No earlier result."""


def write_folder(text: str) -> Callable[[Path], None]:
    """Files and folders of each kind that a folder can get."""

    def work(folder: Path) -> None:
        with whole_folder(folder / "d", earlier=("gone*", "both/*")) as stage:
            for name in ("a", "b", f"gone-{text}", "place/x", f"place/{text}", "both/1", f"both/{text}"):
                (stage / name).parent.mkdir(exist_ok=True)
                (stage / name).write_text(f"{text} {name}")

    return work


def read_folder(folder: Path) -> list[bytes]:
    """All its files."""
    return [path.read_bytes() for path in sorted((folder / "d").rglob("*")) if path.is_file()]


FOLDERS = (
    Scenario("folder", nothing, write_folder("new"), read_folder),
    Scenario("folder-again", write_folder("old"), write_folder("new"), read_folder),
)
