"""`ballfg info`, `ballfg --version`, and that commands answer before anything heavy is imported."""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import pytest

from ballfg.cli.commands.info import extras, packages, required
from ballfg.cli.main import app
from ballfg.cli.start import _command
from tests.commands import printed, refused
from tests.interpreter import Interpreter, fresh
from tests.places import DOCS

GUIDE = (DOCS / "add_an_effect.md").read_text(encoding="utf-8")
HEAVY = ("torch", "gtsam", "cv2", "scipy", "matplotlib")
LIGHTER = ("numpy", "pyarrow", "cloudpickle")
SPY = f"import atexit, sys\natexit.register(lambda: print(set({HEAVY}) & set(sys.modules)))\n"
"""Prints at the end which heavy modules were imported."""


def command(*arguments: str) -> str:
    return f"from ballfg.cli.main import run\nrun({list(arguments)})"


@pytest.fixture(scope="module")
def charged(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Interpreter]:
    """An interpreter that finds the guide's package, installed."""
    folder = tmp_path_factory.mktemp("site")
    project = tomllib.loads(re.findall(r"```toml\n(.*?)```", GUIDE, re.DOTALL)[0])["project"]
    name = project["name"].replace("-", "_")
    (folder / name).mkdir()
    (folder / name / "__init__.py").touch()
    code = re.findall(r"```python\n(.*?)```", GUIDE, re.DOTALL)[0]
    (folder / name / "static_charge.py").write_text(code, encoding="utf-8")
    info = folder / f"{name}-{project['version']}.dist-info"
    info.mkdir()
    metadata = f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    (info / "METADATA").write_text(metadata, encoding="utf-8")
    groups = project["entry-points"].items()
    text = "".join(f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in points.items()) for group, points in groups)
    (info / "entry_points.txt").write_text(text, encoding="utf-8")
    with Interpreter([folder]) as interpreter:
        yield interpreter


def test_version() -> None:
    assert fresh(command("--version")).stdout == f"ballfg {version('ballfg')}\n"


def test_info_lists_packages_machine_and_what_is_registered(charged: Interpreter) -> None:
    done = charged("info")
    assert done.status == 0, done.err
    assert done.out.startswith(f"ballfg {version('ballfg')}, python {sys.version.split()[0]}\n")
    sections = dict(re.findall(r"^(\w+)\n((?:  .*\n)+)", done.out, re.MULTILINE))
    assert list(sections)[:3] == ["packages", "extras", "machine"]
    assert f"  torch {version('torch')}\n" in sections["packages"]
    assert "  diffusion: " in sections["extras"]
    assert "  GPU: " in sections["machine"]
    assert f"  ballfg {version('ballfg')}: gravity, drag, magnus," in sections["effects"]
    assert "  charged-balls 1.0: static_charge\n" in sections["effects"]
    assert "smoother, online, ekf, sliding-window" in sections["estimators"]


def test_extras_that_are_not_installed_come_with_a_remedy() -> None:
    needed = required(["numpy>=2.0", "absent-one", 'no-such-package>=1 ; extra == "more"'])
    assert list(packages(needed)) == [
        f"numpy {version('numpy')}",
        "absent-one is not installed; pip install absent-one",
    ]
    assert list(extras(needed)) == ["more: lacks no-such-package; pip install 'ballfg[more]'"]


def test_commands_use_effects_of_an_installed_package(charged: Interpreter, tmp_path: Path) -> None:
    words = ("simulate", "--out", tmp_path / "shots", "--tracks", 2, "--effect", "static_charge.strength=2")
    done = charged(*words)
    assert "undeclared effects: static_charge" in done.out, done.err
    assert "effect must be one that exists; got 'static_charge'" in refused(*words, "--force")


@pytest.mark.parametrize(
    "arguments",
    [("--help",), ("--version",), *((name, "--help") for name in ("estimate", "predict", "simulate"))],
)
def test_help_imports_nothing_heavy(arguments: tuple[str, ...]) -> None:
    done = fresh(SPY.replace(str(HEAVY), str(HEAVY + LIGHTER)) + command(*arguments))
    assert done.stdout.endswith("\nset()\n"), done.stderr


@pytest.mark.parametrize("name", _command(app).commands)
def test_help_has_an_example(name: str) -> None:
    assert f"Example: ballfg {name}" in " ".join(printed(name, "--help").out.split())


def test_without_a_word_there_is_help() -> None:
    assert "simulate" in printed().out


@pytest.mark.parametrize("name", ["estimate", "predict", "diagnose"])
def test_a_mistyped_path_is_refused_before_anything_heavy_is_imported(name: str, tmp_path: Path) -> None:
    code = command(name, "/no/such/folder", "--out", str(tmp_path / "out.csv"))
    done = fresh(SPY + code)
    assert done.returncode == 2
    assert done.stdout == "set()\n"
    assert done.stderr == (
        "ballfg: error: folder must exist; /no/such/folder does not. Give the folder of a dataset.\n"
    )
