"""Registries: names, order, refusals, and classes of other installed packages."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from ballfg.registry import Registry, Source


class Shape:
    name: str


class Square(Shape):
    name = "square"


class Circle(Shape):
    name = "circle"


OWN_MODULE = "ballfg.shapes"
"""A class of this module counts as one of the package's own."""


def own(name: str) -> type[Shape]:
    return type(name.title(), (Shape,), {"name": name, "__module__": OWN_MODULE})


def registry(**options: object) -> Registry[Shape]:
    return Registry("shape", group="ballfg.shapes", base=Shape, remedy="See the tests.", **options)  # type: ignore[arg-type]


def test_it_is_a_mapping_with_the_packages_own_first() -> None:
    shapes = registry()
    for cls in (Square, own("zigzag"), Circle, own("arc")):
        assert shapes.register(cls) is cls
    assert list(shapes) == ["zigzag", "arc", "circle", "square"]
    assert len(shapes) == 4
    assert shapes["square"] is shapes.lookup("square") is Square
    assert "oval" not in shapes
    assert shapes.get("oval") is None
    assert repr(shapes) == "Registry of shapes: zigzag, arc, circle, square"


def test_a_class_defined_anew_takes_the_place_of_the_one_before() -> None:
    shapes = registry()
    first, again = own("arc"), own("arc")
    shapes.register(first)
    assert shapes.register(again) is again is shapes["arc"]


def test_refusals() -> None:
    shapes = registry(reserved={"dot": own("dot")})
    shapes.register(Square)
    with pytest.raises(TypeError, match=r"^shape must be a subclass of Shape; got 3\. See the tests\.$"):
        shapes.register(3)  # type: ignore[type-var]
    with pytest.raises(ValueError, match=r"^Shape\.name must be a text; it is missing\. See the tests\.$"):
        shapes.register(Shape)
    other = type("Other", (Shape,), {"name": "square"})
    with pytest.raises(ValueError, match=r"got 'square', that of .*Square, for .*Other\. Rename one\.$"):
        shapes.register(other)
    with pytest.raises(ValueError, match=r"^name of a shape must be its own; got 'dot', that of ballfg\.shapes\.Dot"):
        shapes.register(type("Dot", (Shape,), {"name": "dot"}))
    with pytest.raises(ValueError, match=r"^there is no shape 'oval'; known ones: square\. One of your own must be"):
        shapes.lookup("oval")
    assert list(shapes) == ["square"]


def test_its_own_check_refuses() -> None:
    def check(cls: type[Shape]) -> None:
        raise ValueError(f"{cls.name} is too round.")

    shapes = registry(check=check)
    with pytest.raises(ValueError, match=r"^circle is too round\.$"):
        shapes.register(Circle)
    assert not shapes


def test_what_a_test_registers_is_forgotten() -> None:
    shapes = registry()
    shapes.register(Square)
    with shapes.restored():
        shapes.register(Circle)
        assert list(shapes) == ["circle", "square"]
    assert list(shapes) == ["square"]


def test_sources() -> None:
    shapes = registry()
    shapes.register(own("arc"))
    shapes.register(Square)
    assert shapes.source("arc").package == "ballfg"
    assert shapes.source("arc").version is not None
    assert shapes.source("square") == Source(Square.__module__, None)
    assert str(Source("ovals", "2.1")) == "ovals 2.1"


OVALS = """
from tests.test_registry import Shape

class Oval(Shape):
    name = "oval"

class Egg(Shape):
    name = "egg"

def offer():
    from registries import shapes
    shapes.register(Egg)
"""
REGISTRIES = """
from tests.test_registry import Square, registry

shapes = registry()
shapes.register(Square)
"""


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A folder with an installed package, `ovals`, that offers shapes."""
    info = tmp_path / "ovals-2.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: ovals\nVersion: 2.1\n", encoding="utf-8")
    (tmp_path / "ovals.py").write_text(OVALS, encoding="utf-8")
    (tmp_path / "registries.py").write_text(REGISTRIES, encoding="utf-8")
    offer(tmp_path, "oval = ovals:Oval", "egg = ovals:offer")
    return tmp_path


def offer(folder: Path, *lines: str) -> None:
    text = "\n".join(("[ballfg.shapes]", *lines, ""))
    (folder / "ovals-2.1.dist-info" / "entry_points.txt").write_text(text, encoding="utf-8")


def run(folder: Path, code: str) -> subprocess.CompletedProcess[str]:
    paths = os.pathsep.join([str(folder), str(Path(__file__).parents[1])])
    environment = {**os.environ, "PYTHONPATH": paths}
    program = f"import sys\nfrom registries import shapes\n{code}"
    return subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)


def test_classes_of_installed_packages_are_known(installed: Path) -> None:
    done = run(installed, "print(*shapes, shapes.source('oval'), shapes.source('egg'), shapes['oval'].__module__)")
    assert done.stdout == "egg oval square ovals 2.1 ovals 2.1 ovals\n", done.stderr
    found = run(installed, "print(shapes.lookup('egg').__name__)")
    assert found.stdout == "Egg\n", found.stderr


def test_a_module_registers_its_classes(installed: Path) -> None:
    code = "from registries import shapes\nfrom ovals import Egg, Oval\nshapes.register(Oval)\nshapes.register(Egg)\n"
    (installed / "both.py").write_text(code, encoding="utf-8")
    offer(installed, "both = both")
    done = run(installed, "print(*shapes, shapes.source('egg'))")
    assert done.stdout == "egg oval square ovals 2.1\n", done.stderr


def test_packages_are_loaded_when_something_is_missing_and_not_before(installed: Path) -> None:
    done = run(
        installed, "shapes['square']; print('ovals' in sys.modules); print('oval' in shapes, 'ovals' in sys.modules)"
    )
    assert done.stdout == "False\nTrue True\n", done.stderr


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("bad = nowhere:Oval", "ModuleNotFoundError: No module named 'nowhere'"),
        ("bad = ovals:Round", "AttributeError: module 'ovals' has no attribute 'Round'"),
        ("bad = ovals:__doc__", "TypeError: 'NoneType' object is not callable"),
        ("bad = leaving", "SystemExit: 0"),
        ("bad = interrupting", "KeyboardInterrupt: none came"),
        ("bad = odd", "Odd: of no known class"),
        ("bad = fractions:Fraction", "TypeError: shape must be a subclass of Shape; got <class 'fractions.Fraction'>."),
    ],
)
def test_an_entry_point_that_cannot_be_used_is_named(installed: Path, line: str, reason: str) -> None:
    offer(installed, line)
    (installed / "leaving.py").write_text("import sys\nsys.exit(0)\n")
    (installed / "interrupting.py").write_text("raise KeyboardInterrupt('none came')\n")
    (installed / "odd.py").write_text("class Odd(BaseException): ...\nraise Odd('of no known class')\n")
    code = "from ballfg import interrupts\ninterrupts.listen()\n"
    code += "for _ in range(2):\n    try:\n        list(shapes)\n    except ValueError as error:\n        print(error)"
    first, second = run(installed, code).stdout.splitlines()
    value = line.removeprefix("bad = ")
    start = f"entry point 'bad' = '{value}' of package ovals 2.1 (group ballfg.shapes) cannot be used ({reason}"
    assert first == second
    assert first.startswith(start)
    assert first.endswith("). Mend or uninstall that package.")


def test_an_interrupt_while_a_package_is_loaded_is_one(installed: Path) -> None:
    (installed / "slow.py").write_text(
        "import os, signal, time\nos.kill(os.getpid(), signal.SIGTERM)\ntime.sleep(60)\n"
    )
    offer(installed, "slow = slow")
    done = run(installed, "from ballfg import interrupts\ninterrupts.listen()\nlist(shapes)")
    assert done.stderr.endswith("\nKeyboardInterrupt\n")
    assert "Mend or uninstall" not in done.stderr
