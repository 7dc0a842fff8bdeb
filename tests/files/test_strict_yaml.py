"""YAML with the safe loader, no key twice; the error is one line with the place."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import pytest

from ballfg.checks import check_keys, shown
from ballfg.files.strict_yaml import YamlError, parse_yaml, read_mapping, read_yaml


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
    assert read_yaml(written(tmp_path, "007: 1\n7: {yes: {1.50: a}}")) == {"007": 1, "7": {"yes": {"1.50": "a"}}}


@pytest.mark.parametrize(
    ("content", "problem", "line", "repeated"),
    [
        ("a: 1\nb: 2\na: 3", "'a' stands twice", 1, "a"),
        ("a:\n  b: {c: 1, c: 2}", "'c' stands twice", 2, "a.b.c"),
        ("- {c: 1}\n- {d: 1, d: 2}", "'d' stands twice", 2, "d"),
        ("a: [1,\nb: 2", "while parsing a flow sequence, did not find expected ',' or ']'", 3, None),
        ("a: !!python/object:os.system x", "values must be written without a tag; got", 1, None),
        ("a: x\x01", "control characters are not allowed", None, None),
        (b"a: caf\xe9\n", "it must be UTF-8 text; invalid continuation byte", None, None),
        ("a: !!int ''", "values must be written without a tag", 1, None),
        ("- " + "[" * 3000, "values must be nested at most 40 deep", 1, None),
        ("a: &a [*a]", "alias 'a' must not stand within what it names", 1, None),
        ("a: *b", "found undefined alias", 1, None),
        ("a: " + "9" * 400, "a number must have at most 100 digits; got 400", 1, None),
        ("a: " + "9" * 30, "whole numbers must lie within +-2^63", 1, None),
        ("a: 1.0e+400", "'1.0e+400' is larger than any number of double precision", 1, None),
        ("a: 1\nb: 2026-02-30", "'2026-02-30' cannot be read; day is out of range for month", 2, None),
        ("a: 1\n" + 1001 * "b" + ": 1", "a key must have at most 1000 characters; got 'bbb", 2, None),
        ("? [a, b]\n: 1", "a key must be a word", 1, None),
        ("a: [" + "1, " * 300_000 + "]", "it must hold at most 250000 values, aliases written out", 1, None),
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


def test_aliases_that_multiply_are_refused_before_they_do(tmp_path: Path) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 9)]
    path = written(tmp_path, "\n".join(lines))
    assert path.stat().st_size < 500
    tracemalloc.start()
    try:
        with pytest.raises(YamlError, match="it must hold at most 250000 values, aliases written out in its line 6"):
            read_yaml(path)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000  # bytes; written out they take gigabytes
    finally:
        tracemalloc.stop()


def test_an_alias_counts_as_what_it_names() -> None:
    """A list of 1000 words is 1001 values; it stands there 249 times, the outer list is one, and 750 words are left."""
    lines = [f"- &a [{', '.join('x' * 1000)}]", *["- *a"] * 248, *["- x"] * 750]
    assert len(parse_yaml("\n".join(lines), "here")) == len(lines)
    with pytest.raises(YamlError, match="it must hold at most 250000 values, aliases written out in its line 1000"):
        parse_yaml("\n".join([*lines, "- x"]), "here")


def test_what_is_long_is_named_by_its_beginning(tmp_path: Path) -> None:
    content = "\n".join(f"k{i}: {{a: 1}}" for i in range(2_000))
    with pytest.raises(ValueError, match=r"got k0, .*, k11 and 1988 more\. Add it\.") as caught:
        check_keys("x", read_yaml(written(tmp_path, content)), [f"k{i}" for i in range(2_000)], ["wanted"])
    assert len(str(caught.value)) < 200
    assert (
        shown({"a": [[1] * 1000] * 1000})
        == "{'a': [[1, 1, 1, 1, 1, 1, 1, 1, ...], [1, 1, 1, 1, 1, 1, 1, 1, ...], [1, 1, 1..."
    )
    assert shown("x" * 1000)[:20] == "'" + "x" * 19
    assert shown(b"short") == "b'short'"


def test_a_mapping_is_needed(tmp_path: Path) -> None:
    for content, got in (("", "nothing"), ("{}", "an empty one"), ("- a", "list")):
        with pytest.raises(ValueError, match=rf"a\.yaml: the content must be a mapping; got {got}\. Write it as"):
            read_mapping(written(tmp_path, content))
    with pytest.raises(FileNotFoundError, match=r"none\.yaml: must be a file that exists\. Correct the path\."):
        read_mapping(tmp_path / "none.yaml")
