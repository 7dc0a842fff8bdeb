"""JSON that anybody may have written."""

import json
from pathlib import Path

import pytest

from ballfg.files.json_file import parse_json, read_json


def test_content_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"a": [1, 2.5, null, "é"]}', encoding="utf-8")
    assert read_json(tmp_path / "a.json") == {"a": [1, 2.5, None, "é"]}


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "line 1"),
        (b'{"a":\n', "line 2"),
        (b'"\xff"', "no text in UTF-8"),
        (b"[" * 100_000, "nested too deep"),
        (b"9" * 5000, "too many digits"),
    ],
)
def test_what_cannot_be_read_is_a_plain_value_error(tmp_path: Path, content: bytes, problem: str) -> None:
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(ValueError, match=problem) as caught:
        read_json(tmp_path / "a.json")
    assert type(caught.value) is ValueError
    assert "\n" not in str(caught.value)


def test_text_has_one_kind_of_error() -> None:
    for text in ("[" * 100_000, "9" * 5000, "{"):
        with pytest.raises(json.JSONDecodeError):
            parse_json(text)
