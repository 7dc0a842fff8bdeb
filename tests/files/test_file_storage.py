"""OpenCV's files read without OpenCV's parser: the same numbers, and damaged files are refused, not trusted."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from ballfg.files.file_storage import ENDINGS, is_matrix, number, numbers, read_storage

rng = np.random.default_rng(5)
MATRICES = {
    "double": rng.normal(size=(3, 4)) * 10.0 ** rng.integers(-12, 12, (3, 4)),
    "single": rng.normal(size=(1, 5)).astype(np.float32),
    "whole": rng.integers(-9, 9, (4, 1)).astype(np.int32),
    "bytes": rng.integers(0, 255, (2, 2)).astype(np.uint8),
    "channels": rng.normal(size=(2, 3, 2)),
    "line": rng.normal(size=3),
    "none": np.zeros((0, 3)),
    "strange": np.array([[np.inf, -np.inf, 1e-300]]),
}


def written(path: Path) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("note", "it's 5 \"o'clock\"\n & more")
    for name, matrix in MATRICES.items():
        storage.write(name, matrix)
    storage.startWriteStruct("left", cv2.FileNode_MAP)
    storage.write("image_width", 1280)
    storage.write("gain", 0.1 + 0.2)
    storage.endWriteStruct()
    storage.startWriteStruct("several", cv2.FileNode_SEQ)
    for value in (1.5, 2, -3e-7):
        storage.write("", value)
    storage.endWriteStruct()
    storage.release()
    return path


@pytest.mark.parametrize("ending", ENDINGS)
def test_numbers_are_those_that_opencv_reads(tmp_path: Path, ending: str) -> None:
    path = written(tmp_path / f"a{ending}")
    ours, theirs = read_storage(path), cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert set(ours) == {"note", "left", "several", *MATRICES}
    for name in MATRICES:
        assert is_matrix(ours[name])
        matrix = theirs.getNode(name).mat()
        expected = [] if matrix is None else matrix.ravel().tolist()
        assert np.ravel(numbers(ours[name], name)).tolist() == expected, name
    assert np.shape(numbers(ours["double"], "")) == (3, 4)
    assert np.shape(numbers(ours["single"], "")) == (5,)
    left = ours["left"]
    assert isinstance(left, dict)
    assert (number(left["image_width"], ""), number(left["gain"], "")) == (1280, 0.1 + 0.2)
    assert numbers(ours["several"], "") == [1.5, 2, -3e-7]


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_matrix_whose_shape_does_not_fit_is_refused(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"a{ending}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("m", np.eye(3))
    storage.release()
    good = path.read_text()
    quote = '"' if ending == ".json" else ""
    close = {"rows": "3</rows>", "cols": "3</cols>", "dt": "d</dt>"} if ending == ".xml" else {}
    for key, old, new, message in (
        ("rows", "3", "1000000000", "m, rows must be a whole number of at most 1000000; got '1000000000'"),
        ("cols", "3", "-3", "m, cols must be a whole number"),
        ("rows", "3", "4", "m, data must hold 12 numbers as rows, cols and dt say; got 9"),
        ("dt", "d", "9d", "m, data must hold 81 numbers"),
        ("dt", "d", "q", "m, dt must be a type such as d; got 'q'"),
    ):
        before = close.get(key, f"{quote}{key}{quote}: {quote if key == 'dt' else ''}{old}")
        after = (
            before.replace(f"{old}<", f"{new}<")
            if close
            else before.replace(
                f": {before[-len(old) - len(quote) * (key == 'dt') :]}", f": {quote if key == 'dt' else ''}{new}"
            )
        )
        assert good.count(before) == 1
        path.write_text(good.replace(before, after))
        with pytest.raises(ValueError, match=message):
            numbers(read_storage(path)["m"], "m")
    path.write_text(good.replace("cols", "columns"))
    with pytest.raises(ValueError, match="m must be a matrix or a list of numbers"):
        numbers(read_storage(path)["m"], "m")


@pytest.mark.parametrize(
    ("ending", "text", "message"),
    [
        (".xml", "<opencv_storage><a>1</a>", "it cannot be parsed"),
        (".xml", "<other><a>1</a></other>", "its outer node must be opencv_storage"),
        (".xml", "<opencv_storage><a>1</a><a>2</a></opencv_storage>", "'a' stands twice"),
        (".xml", "<!DOCTYPE x [<!ENTITY a 'b'>]><opencv_storage>&a;</opencv_storage>", "declarations such as"),
        (".xml", "<opencv_storage>" + "<a>" * 60 + "</a>" * 60 + "</opencv_storage>", "nested at most 40 deep"),
        (".xml", "<opencv_storage>" + "<a/>" * 600_000 + "</opencv_storage>", "must have at most 1 MB"),
        (".xml", "<opencv_storage>1 2</opencv_storage>", "with names at its top"),
        (".xml", "", "it cannot be parsed"),
        (".json", '{"a": [1, 2}', "it cannot be parsed"),
        (".json", "[1, 2]", "with names at its top"),
        (".json", '{"a": ' + "[" * 2000, "nested at most 40 deep"),
        (".yml", "%YAML:1.0\n---\na: &a [*a]", "must not stand within what it names"),
        (".yml", "%YAML:1.0\n---\na: !!python/name:os.system", "without a tag"),
    ],
)
def test_what_is_no_storage_is_refused(tmp_path: Path, ending: str, text: str, message: str) -> None:
    path = tmp_path / f"a{ending}"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        read_storage(path)
    assert str(caught.value).startswith(str(path))
    assert len(str(caught.value)) < len(str(path)) + 300


def refusal(path: Path) -> str:
    """What reading all matrices of a file ends with; empty if it ends well."""
    try:
        for name, node in read_storage(path).items():
            if is_matrix(node):
                numbers(node, f"{path}: {name}")
    except ValueError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("ending", ENDINGS)
def test_damage_ends_in_a_message(tmp_path: Path, ending: str) -> None:
    """Bytes changed, cut out and doubled: each file is read or refused, in a sentence that names it."""
    path = written(tmp_path / f"a{ending}")
    good, generator = path.read_bytes(), np.random.default_rng(11)
    refused = 0
    for _ in range(300):
        damaged = bytearray(good)
        for _ in range(generator.integers(1, 4)):
            at, how = int(generator.integers(len(damaged))), generator.integers(3)
            if how == 0:
                damaged[at] = generator.integers(256)
            elif how == 1:
                del damaged[at : at + int(generator.integers(1, 40))]
            else:
                damaged[at:at] = damaged[at : at + int(generator.integers(1, 40))]
        path.write_bytes(damaged)
        refused += refusal(path).startswith(str(path))
    assert 30 < refused < 290


@pytest.mark.parametrize("tag", ["a", "_"], ids=["names", "list"])
def test_forty_nodes_deep_is_the_deepest(tmp_path: Path, tag: str) -> None:
    """A list in a list counts as a name in a name does."""

    def nested(depth: int) -> Path:
        path = tmp_path / f"{depth}.xml"
        inner = f"<{tag}>" * (depth - 1) + "1" + f"</{tag}>" * (depth - 1)
        path.write_text(f"<opencv_storage><x>{inner}</x></opencv_storage>")
        return path

    found = read_storage(nested(40))["x"]
    for _ in range(39):
        found = found[0] if tag == "_" else found[tag]  # type: ignore[index, call-overload]
    assert found == "1"
    with pytest.raises(ValueError, match="nested at most 40 deep"):
        read_storage(nested(41))
