"""YAML with the safe loader, no key twice; the error is one line with the place."""

from __future__ import annotations

from pathlib import Path

import pytest

from ballfg.files.strict_yaml import YamlError, read_mapping, read_yaml


def written(folder: Path, content: str | bytes) -> Path:
    path = folder / "a.yaml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def test_what_is_read(tmp_path: Path) -> None:
    assert read_yaml(written(tmp_path, "a: 1\nb: {a: [x, {c: 2.5}]}\n")) == {"a": 1, "b": {"a": ["x", {"c": 2.5}]}}
    assert read_yaml(written(tmp_path, "\ufeffa: caf\u00e9")) == {"a": "caf\u00e9"}
    assert read_yaml(written(tmp_path, "base: &b {k: 1}\nsame: *b\nmore: {<<: *b, l: 2}")) == {
        "base": {"k": 1},
        "same": {"k": 1},
        "more": {"k": 1, "l": 2},
    }
    assert read_yaml(written(tmp_path, "")) is None


@pytest.mark.parametrize(
    ("content", "problem", "line", "repeated"),
    [
        ("a: 1\nb: 2\na: 3", "'a' stands twice", 1, "a"),
        ("a:\n  b: {c: 1, c: 2}", "'c' stands twice", 2, "a.b.c"),
        ("- {c: 1}\n- {d: 1, d: 2}", "'d' stands twice", 2, "d"),
        ("a: [1,\nb: 2", "while parsing a flow sequence, expected ',' or ']', but got '<stream end>'", 2, None),
        ("a: !!python/object:os.system x", "could not determine a constructor for the tag", 1, None),
        ("a: x\x01", "special characters are not allowed", None, None),
        (b"a: caf\xe9\n", "it must be UTF-8 text; invalid continuation byte", None, None),
        ("a: 1\n---\nb: 2", "expected a single document in the stream, but found another document", 2, None),
    ],
)
def test_what_is_refused(
    tmp_path: Path, content: str | bytes, problem: str, line: int | None, repeated: str | None
) -> None:
    path = written(tmp_path, content)
    with pytest.raises(YamlError) as caught:
        read_yaml(path)
    error = caught.value
    assert error.problem.startswith(problem)
    assert (error.line, error.repeated) == (line, repeated)
    place = "" if line is None else f" in its line {line}"
    assert str(error) == f"{path}: not readable as YAML ({error.problem}{place})"


def test_a_mapping_is_needed(tmp_path: Path) -> None:
    for content, got in (("", "nothing"), ("{}", "an empty one"), ("- a", "list")):
        with pytest.raises(ValueError, match=rf"a\.yaml: the content must be a mapping; got {got}\. Write it as"):
            read_mapping(written(tmp_path, content))
    with pytest.raises(FileNotFoundError, match=r"none\.yaml: must be a file that exists\. Correct the path\."):
        read_mapping(tmp_path / "none.yaml")
