"""Every public name tells its types, the shapes and units of arrays, and the exceptions that it raises."""

from __future__ import annotations

import ast
from types import ModuleType

import pytest

from tests.public_names.check import ROOMS, check_class, check_function, report
from tests.public_names.docstring import Text, has_unit, shapes
from tests.public_names.source import DEFINITION, Source


@pytest.mark.parametrize("room", ROOMS)
def test_public_names_are_described(room: str) -> None:
    told = report(room)
    assert "lacks nothing" in told or "no public names" in told, f"\n{told}"


def lacks(code: str) -> list[str]:
    """What the last function or class of a piece of code lacks."""
    tree = ast.parse(code)
    source, node = Source(ModuleType("made"), tree), tree.body[-1]
    if isinstance(node, ast.ClassDef):
        return check_class(node, source)
    assert isinstance(node, DEFINITION)
    return check_function(node, source, [Text.parse(ast.get_docstring(node))])


ALIAS = 'Array = NDArray[float]\nPlace = Array\n"""(n, 3) m."""\n'


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ('def f(a: int) -> int:\n    """One."""', []),
        ("def f(a: int) -> int: ...", ["no docstring"]),
        ('def f(a: int) -> int:\n    """One"""', ["first line does not end in a period: 'One'"]),
        ('def f(a, *b):\n    """One."""', ["parameter a: no type", "parameter b: no type", "returns: no type"]),
        ('def f(a: Array) -> int:\n    """One."""', ["parameter a: not described (shape and unit)"]),
        ('def f(a: Array) -> int:\n    """One of a (n, 3)."""', ["parameter a: no unit"]),
        ('def f(a: Array) -> int:\n    """One of a (n, 3) m."""', []),
        ('def f(a: Array) -> int:\n    """One.\n\n    Args:\n        a: in m.\n    """', ["parameter a: no shape"]),
        ('def f(a: Array, b: Array) -> int:\n    """One.\n\n    Args: a: (n,) m.  b: (n, 3) rad.\n    """', []),
        ('def f(a: Array) -> Array:\n    """(n,) s of stamps a (n,)."""', []),
        ('def f(a: Array) -> Array:\n    """Stamps s of a (n,)."""', ["returns: not described (shape and unit)"]),
        ('def f() -> tuple[Array, Array]:\n    """(n,) s."""', ["returns: 2 arrays, fewer shapes"]),
        ('def f(a: Place) -> "Place | None":\n    """The type tells."""', []),
        ('def f(a: Callable[[Array], Array]) -> None:\n    """Functions are no arrays."""', []),
        ('def f() -> "NDArray[np.bool_]":\n    """(n,) those that are good."""', []),
        ('def f() -> None:\n    """One."""\n    raise ValueError("no")', ["Raises: does not name ValueError"]),
        ('def f() -> None:\n    """One.\n\n    Raises: ValueError: always.\n    """\n    raise ValueError("no")', []),
        ("def f() -> None:\n    '''One.'''\n    try:\n        raise KeyError\n    except KeyError:\n        pass", []),
        (
            'def _g():\n    raise OSError\n\ndef f() -> None:\n    """One."""\n    _g()',
            ["Raises: does not name OSError"],
        ),
        ('class C:\n    """One."""\n    a: Array', ["field a: not described (shape and unit)"]),
        ('class C:\n    """One."""\n    a: Array\n    """(n,) whitened."""', []),
        ('class C:\n    """One.\n\n    Attributes:\n        a: (n, 9) states.\n    """\n    a: Array', []),
    ],
)
def test_checker_finds_what_is_missing(code: str, expected: list[str]) -> None:
    assert lacks(ALIAS + code) == expected


@pytest.mark.parametrize("text", ["(n, 3)", "(...)", "(..., 9 + p)", "(n,)", "one ()", "(2n, 3)", "(n, len(heights))"])
def test_shapes_are_seen(text: str) -> None:
    assert len(shapes(text)) == 1


@pytest.mark.parametrize("text", ["f()", "(x, y, z)", "(m)", "(z forward, x right)", "(see below)"])
def test_what_looks_like_a_shape_is_none(text: str) -> None:
    assert not shapes(text)


@pytest.mark.parametrize("text", ["(n, 3) m", "px/m", "in m/s^2", "rad/s, at the first", "1/s", "(n,) indices"])
def test_units_are_seen(text: str) -> None:
    assert has_unit(text)


@pytest.mark.parametrize("text", ["(m, n)", "the camera's", "a `s` in backticks", "all that there is"])
def test_what_looks_like_a_unit_is_none(text: str) -> None:
    assert not has_unit(text)
