"""Lines of a sender: what is understood, and what is said of the rest."""

from __future__ import annotations

import pytest

from ballfg.live.sources.sender import LineReader, Sample


@pytest.mark.parametrize(
    ("line", "sample"),
    [
        ("0.1,1,2,3", Sample(0.1, [[1.0, 2.0, 3.0]])),
        (" 0.1, 1e0 ,2,3\r", Sample(0.1, [[1.0, 2.0, 3.0]])),
        ("0.1,1,2,3,0.01,0.02,0.03", Sample(0.1, [[1.0, 2.0, 3.0]], [[0.01, 0.02, 0.03]])),
        ('{"t": 0.1, "x": 1, "y": 2, "z": 3}', Sample(0.1, [[1.0, 2.0, 3.0]])),
        ('{"t": 0.1, "position": [1, 2, 3], "sigma": 0.01}', Sample(0.1, [[1.0, 2.0, 3.0]], [[0.01] * 3])),
        ('{"t": 0.1, "positions": [[1, 2, 3], [4, 5, 6]]}', Sample(0.1, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])),
        (
            '{"t": 0.1, "positions": [[1, 2, 3], [4, 5, 6]], "sigma": [1, 2, 3]}',
            Sample(0.1, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], [[1.0, 2.0, 3.0]] * 2),
        ),
        ("[0.1, 1, 2, 3]", Sample(0.1, [[1.0, 2.0, 3.0]])),
        ("", None),
        ("# a comment", None),
        ("t,x,y,z", None),
    ],
)
def test_lines_are_understood(line: str, sample: Sample | None) -> None:
    assert LineReader().read(line.encode()) == sample


def test_a_header_names_the_columns() -> None:
    reader = LineReader()
    assert reader.read(b"trajectory,z,t,y,x,sigma_x,sigma_y,sigma_z") is None
    assert reader.read(b"000,3,0.1,2,1,0.01,0.02,0.03") == Sample(0.1, [[1.0, 2.0, 3.0]], [[0.01, 0.02, 0.03]])
    with pytest.raises(ValueError, match="must have the 8 cells of its header; got 4"):
        reader.read(b"0.1,1,2,3")


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        (b"0.1,1,2", "a CSV line must be t,x,y,z"),
        (b"0.1,1,2,three", "a number was expected; got 'three'"),
        (b"\xff\xfe\x00", "a CSV line must be"),
        (b"{", "not valid JSON"),
        (b"[" * 10000, "not valid JSON"),
        (b'{"x": 1, "y": 2, "z": 3}', "must be an object with t"),
        (b'{"t": 0.1, "x": 1, "y": 2}', "a JSON line must have x, y and z, or position, or positions; it lacks z"),
        (b'{"t": 0.1, "x": 1, "y": 2, "z": null}', "a number was expected; got 'None'"),
        (b'{"t": true, "x": 1, "y": 2, "z": 3}', "a number was expected; got 'True'"),
        (b'{"t": 0.1, "positions": []}', "must hold at least one"),
        (b'{"t": 0.1, "positions": [[1, 2]]}', "must be lists of three numbers"),
        (b'{"t": 0.1, "positions": [[1, 2, 3]], "sigma": [[1, 1, 1], [1, 1, 1]]}', "sigma must be one for each of 1"),
        (b"1" * 70000, "at most 65536 bytes"),
    ],
)
def test_the_rest_is_refused(line: bytes, problem: str) -> None:
    with pytest.raises(ValueError, match=problem.replace("[", r"\[")):
        LineReader().read(line)
