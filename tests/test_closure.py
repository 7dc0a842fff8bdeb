"""How much of the package an estimate imports: what the modules on its way name at their top, found by their syntax.

`python -m tests.test_closure` prints the files. Diagnosis, importing, vision and learning are imported when used.
"""

import ast
import subprocess
import sys
from collections.abc import Iterable, Iterator

from tests.interpreter import fresh
from tests.test_layout import MODULES

STARTS = (
    "ballfg.front",
    "ballfg.estimation.smoother.smoother",
    "ballfg.estimation.flights.estimates",
    *(f"ballfg.dynamics.effects.{kind}" for kind in ("flight", "bounce", "measurement")),
)
"""The door, and what is imported by its name: the default estimator, the flights of a track, the effects."""
MOST_FILES = 156
LATER = ("diagnosis", "importing", "vision", "learning", "simulation", "parallel", "live")


def at_top(body: Iterable[ast.stmt]) -> Iterator[ast.Import | ast.ImportFrom]:
    """The imports that run when a module is imported."""
    for node in body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        elif isinstance(node, ast.If):
            yield from at_top(node.orelse if "TYPE_CHECKING" in ast.unparse(node.test) else [*node.body, *node.orelse])
        elif isinstance(node, ast.Try | ast.With | ast.ClassDef):
            yield from at_top(node.body)


def imports(module: str, body: Iterable[ast.stmt]) -> Iterator[tuple[str, str]]:
    """Module and name of each import; the name is empty where the module itself is imported."""
    package = module if MODULES.get(module) and MODULES[module].name == "__init__.py" else module.rpartition(".")[0]
    for node in at_top(body):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        else:
            up = ".".join(package.split(".")[: len(package.split(".")) - node.level + 1]) if node.level else ""
            base = ".".join(filter(None, (up, node.module)))
            yield from ((base, alias.name) for alias in node.names)


def stub(module: str) -> dict[str, tuple[str, str]]:
    """Where the lazily imported names of a room come from."""
    path = MODULES[module].with_suffix(".pyi") if module in MODULES else None
    if path is None or path.name != "__init__.pyi" or not path.is_file():
        return {}
    return {name: (base, name) for base, name in imports(module, ast.parse(path.read_text(encoding="utf-8")).body)}


def closure(starts: Iterable[str]) -> set[str]:
    """The modules of the package that are imported with others, those among them."""
    found: set[str] = set()
    left = [(start, "") for start in starts]
    while left:
        module, name = left.pop()
        if module not in MODULES:
            continue
        if name:
            left.append((f"{module}.{name}", "") if f"{module}.{name}" in MODULES else stub(module).get(name, ("", "")))
        if module not in found:
            found.add(module)
            left.append((module.rpartition(".")[0], ""))
            left += imports(module, ast.parse(MODULES[module].read_text(encoding="utf-8")).body)
    return found


def test_an_estimate_imports_no_more_than_it_needs() -> None:
    found = closure(STARTS)
    assert "ballfg.factors.linear.elimination" in found  # the whole way
    assert not {module for module in found if module.split(".")[1:2] and module.split(".")[1] in LATER}
    assert len(found) <= MOST_FILES


def test_what_is_imported_is_what_the_syntax_says() -> None:
    """In a process of its own, after an estimate: nothing else was imported by the way, but machine code.

    A second process finds the machine code that the first one made, and needs no package that only others need.
    """
    code = (
        "import sys, numpy as np, ballfg as bf; t = np.arange(40) * 0.01;"
        "bf.estimate((t, np.stack([4 * t, 0 * t, 1 + t - 4.9 * t**2], 1)));"
        "print(*sys.modules)"
    )
    for _ in range(2):
        said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    modules = set(said.stdout.split())
    assert {module for module in modules if module.split(".")[0] == "ballfg"} <= closure(STARTS)
    unneeded = {"cv2", "gtsam", "pandas", "scipy.optimize", "scipy.sparse", "scipy.special", "sympy", "torch"}
    assert not modules & unneeded


def test_the_online_estimator_needs_nothing_of_scipy() -> None:
    """A robot's program starts without it: its linear algebra takes some tenths of a second to import."""
    said = fresh("import sys; from ballfg.estimation import Online; print(*sys.modules)", check=True).stdout
    modules = set(said.split())
    assert "ballfg.estimation.online.final" in modules
    assert not modules & {"gtsam", "scipy.linalg", "scipy.optimize", "scipy.sparse", "scipy.special", "torch"}


if __name__ == "__main__":
    print(*sorted(closure(STARTS)), f"{len(closure(STARTS))} files", sep="\n")
