"""A folder's files are there all together or not at all."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from ballfg.files.whole_folder import check_replaceable, recover, replaced_folder, whole_folder


def contents(folder: Path) -> dict[str, str]:
    """Every file below a folder, hidden ones too."""
    return {str(p.relative_to(folder)): p.read_text() for p in sorted(folder.rglob("*")) if p.is_file()}


def fill(folder: Path, **files: str) -> None:
    """Writes files; in a name `__` stands for a folder's slash."""
    for name, text in files.items():
        path = folder / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


# --- files that join a folder ------------------------------------------------------------------------------------


def test_a_new_folder_appears_at_once(tmp_path: Path) -> None:
    with whole_folder(tmp_path / "new") as stage:
        fill(stage, a="1", below__b="2")
        assert not (tmp_path / "new").exists()
    assert contents(tmp_path) == {"new/a": "1", "new/below/b": "2"}
    assert [path.name for path in tmp_path.iterdir()] == ["new"]


def test_an_earlier_result_is_replaced_and_other_files_stay(tmp_path: Path) -> None:
    fill(tmp_path, a="old", gone="old", mine="mine", images__x="old", images__y="old", data_1__w="old", place="old")
    with whole_folder(tmp_path, earlier=("a", "gone", "data_*", "..")) as stage:
        fill(stage, a="new", images__x="new", data_2__w="new", place__z="new")
    new = {"a": "new", "images/x": "new", "data_2/w": "new", "place/z": "new"}
    assert contents(tmp_path) == new | {"mine": "mine"}
    assert {path.name for path in tmp_path.iterdir()} == {"a", "images", "data_2", "mine", "place"}


def test_the_last_name_moves_last_and_folders_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    moved: list[str] = []
    real = os.replace

    def replace(source: Any, target: Any) -> None:
        moved.append(Path(target).name)
        real(source, target)

    monkeypatch.setattr("os.replace", replace)
    with whole_folder(tmp_path, last="a") as stage:
        fill(stage, a="", b="", z__x="")
    assert moved == ["z", "b", "a"]


@pytest.mark.parametrize("exists", [False, True])
@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_exception_leaves_what_was_there(tmp_path: Path, exists: bool, error: type[BaseException]) -> None:
    folder = tmp_path / "d"
    if exists:
        fill(folder, a="old")

    def broken() -> None:
        with whole_folder(folder, earlier=("a",)) as stage:
            fill(stage, b="new")
            raise error

    with pytest.raises(error):
        broken()
    assert contents(tmp_path) == ({"d/a": "old"} if exists else {})
    assert folder.exists() == exists


# --- a folder that takes the place of another --------------------------------------------------------------------


def test_a_folder_takes_the_place_of_the_old_one(tmp_path: Path) -> None:
    for number in "12":
        with replaced_folder(tmp_path / "d") as stage:
            fill(stage, **{f"a{number}": number})
    assert contents(tmp_path) == {"d/a2": "2"}
    assert [path.name for path in tmp_path.iterdir()] == ["d"]


def test_recovery_after_a_crash_between_the_two_steps(tmp_path: Path) -> None:
    fill(tmp_path / ".d.old", a="old")
    recover(tmp_path / "d")
    assert contents(tmp_path) == {"d/a": "old"}
    fill(tmp_path / ".d.old", a="older")
    recover(tmp_path / "d")
    assert contents(tmp_path) == {"d/a": "old"}


def test_a_crash_leaves_files_that_the_next_writing_clears(tmp_path: Path) -> None:
    fill(tmp_path, d__a="old", **{".d.part__half": "half"})
    with replaced_folder(tmp_path / "d") as stage:
        fill(stage, b="new")
    assert contents(tmp_path) == {"d/b": "new"}


# --- folders in which something would be lost --------------------------------------------------------------------


def test_what_may_be_replaced(tmp_path: Path) -> None:
    what = {"mark": "report", "what": "an earlier report"}
    check_replaceable(tmp_path, **what)
    check_replaceable(tmp_path / "new", **what)
    fill(tmp_path, report="")
    check_replaceable(tmp_path, **what, only=("report",))
    with pytest.raises(ValueError, match=r"out must be new or empty; .* holds an earlier report"):
        check_replaceable(tmp_path, **what, force=False)
    fill(tmp_path, other="")
    check_replaceable(tmp_path, **what)
    message = r"out must be new, empty or hold an earlier report; .* holds other files\. Choose another name\."
    with pytest.raises(ValueError, match=message):
        check_replaceable(tmp_path, **what, only=("report",))
    with pytest.raises(ValueError, match=message):
        check_replaceable(tmp_path, mark="none", what="an earlier report")
    with pytest.raises(ValueError, match=r"out must be a folder; .*report is a file"):
        check_replaceable(tmp_path / "report", **what)
    with pytest.raises(FileNotFoundError, match=r"out must be in an existing folder; .*no is none"):
        check_replaceable(tmp_path / "no" / "d", **what)
