"""The changes that `make mutants` tries: what they are, what they leave alone, and that their choice is fixed."""

from __future__ import annotations

import ast

import pytest

from tests.mutants.__main__ import _shares, judged, ordered, sample
from tests.mutants.mutations import mutations_of
from tests.mutants.reach import Names
from tests.mutants.sources import room_of, source_files
from tests.places import ROOT

FORMS = {
    "comparison": ("if a < b: pass", {"if a >= b: pass"}),
    "chained comparison": ("x = a <= b is c", {"x = a > b is c", "x = a <= b is not c"}),
    "membership": ("x = a not in b", {"x = a in b"}),
    "sum": ("x = a + b - c", {"x = a - b - c", "x = a + b + c"}),
    "product over lines": ("x = (a *\n b)", {"x = (a /\n b)"}),
    "text is no sum": ("x = a + 'b' + f'{c + d}'", set()),
    "logic": ("x = a and b", {"x = a or b"}),
    "sign": ("x = -a", {"x = (a)"}),
    "not": ("x = not a", {"x = (a)"}),
    "constants": ("x = f(0, 2.5, True)", {"x = f(1, 2.5, True)", "x = f(0, (2 * 2.5), True)"}),
    "zero stays a float": ("x = 0.0", {"x = 1.0"}),
    "index": ("x = a[0, -1]", {"x = a[0 + 1, -1]", "x = a[0, -1 - 1]"}),
    "a call in an index": ("x = a[f(2)]", {"x = a[f((2 * 2))]"}),
    "largest": ("x = np.max(a)", {"x = np.min(a)"}),
    "bound": ("x = np.clip(a, b, c)", {"x = (a)"}),
    "bound as a method": ("x = a.sum().clip(b)", {"x = a.sum()"}),
    "one of two": ("x = max(a, b)", {"x = min(a, b)", "x = (a)"}),
    "statement": ("a.append(b)", {"pass"}),
    "part of an array": ("a[b] = c", {"pass"}),
    "growing": ("a += b", {"a -= b", "pass"}),
    "a new name is not dropped": ("a = b", set()),
    "number": ("def f(x: int = 3) -> float: return x", {
        "def f(x: int = (2 * 3)) -> float: return x", "def f(x: int = 3) -> float: return -(x)"
    }),
    "truth": ("def f() -> bool: return x", {"def f() -> bool: return not (x)"}),
    "texts": ('def f():\n "doc"\n raise E(1 + 2)', set()),
    "how it looks": ("def __repr__(self): return 1 + 2", set()),
    "for types": ("if TYPE_CHECKING: f(1)", set()),
    "annotation": ("a: Annotated[int, 3] = b", set()),
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_a_form_has_these_changes(form: str) -> None:
    source, expected = FORMS[form]
    found = mutations_of("a.py", source.encode())
    assert {m.applied(source.encode()).decode() for m in found} == expected


def test_letters_beyond_ascii_do_not_move_a_change() -> None:
    source = "x = 'σ'; y = a < b  # µ"
    (change,) = mutations_of("a.py", source.encode())
    assert change.applied(source.encode()).decode() == "x = 'σ'; y = a >= b  # µ"
    assert (change.line, change.old_line) == (1, source)


def test_changed_files_are_python() -> None:
    name = "ballfg/estimation/filters/ekf.py"
    source = (ROOT / name).read_bytes()
    found = mutations_of(name, source)
    assert len(found) > 100
    for change in found[::5]:
        ast.parse(change.applied(source))


def test_the_choice_is_fixed_and_in_proportion() -> None:
    rooms = ["prediction", "files"]
    assert sample(12, 0, rooms) == sample(12, 0, rooms) != sample(12, 1, rooms)
    assert {room_of(m.file) for m in sample(12, 0, rooms)} == set(rooms)
    assert _shares({"a": 70, "b": 25, "c": 5}, 10) == {"a": 7, "b": 3, "c": 0}
    with pytest.raises(SystemExit, match=r"--rooms must be of ballfg, benchmarks, .*; got kitchen"):
        sample(1, 0, ["kitchen"])


def test_each_file_counts_once_where_it_lies() -> None:
    files = source_files()
    assert len(files) == len(set(files))
    assert "factors/graph.py" in files
    assert not any(
        name.startswith(("ballfg/factors/", "ballfg/cli/")) or name.endswith("__init__.py") for name in files
    )


def test_tests_of_a_file_stay_together_and_those_nearby_come_first() -> None:
    tests = {
        "tests/tracks/test_table.py::a": 2.0,
        "tests/cli/test_show.py::a": 1.0,
        "tests/cli/test_show.py::b": 0.1,
        "tests/cli/test_track.py::a": 30.0,
    }
    near, far = ["tests/tracks/test_table.py::a"], ["tests/cli/test_show.py::b", "tests/cli/test_show.py::a"]
    assert ordered(tests, "ballfg/tracks/table.py", 60.0) == [*near, *far, "tests/cli/test_track.py::a"]
    assert ordered(tests, "ballfg/pages/html.py", 10.0) == [*far, *near]


@pytest.fixture(scope="module")
def names() -> Names:
    return Names()


def test_a_constant_is_used_by_those_who_import_it(names: Names) -> None:
    file = "ballfg/state.py"
    line = (ROOT / file).read_text(encoding="utf-8").splitlines().index("STATE_DIM: Final = 9") + 1
    assert names.defined(file, line) == "STATE_DIM"
    assert "factors/noise.py" in {user for user, _ in names.uses(file, "STATE_DIM")}
    compiled = {"ballfg/dynamics/compiled/beliefs/course.py"}
    assert names.frozen_in_machine_code(file, line, compiled)  # what is compiled holds its value
    text = (ROOT / "ballfg/prediction/forecast.py").read_text(encoding="utf-8").splitlines()
    line = text.index('    def plot(self) -> "Figure":') + 1
    assert text[names.headed("ballfg/prediction/forecast.py", line)[-1] - 1].strip().startswith("return by_axis(")
    assert not names.headed("ballfg/prediction/forecast.py", line + 1)
    assert not names.frozen_in_machine_code("factors/noise.py", 60, compiled)


def test_a_name_is_used_under_another_one_and_by_generated_code(names: Names) -> None:
    file = "ballfg/dynamics/compiled/motion.py"
    lines = (ROOT / file).read_text(encoding="utf-8").splitlines()
    assert "from ballfg.dynamics.compiled.roll_out import roll_out as roll_out_rows" in lines
    called = [i for i, line in enumerate(lines, 1) if line.strip().startswith("roll_out_rows(")]
    assert called
    assert {(file, i) for i in called} <= set(names.uses("ballfg/dynamics/compiled/roll_out.py", "roll_out"))
    helpers = {user for user, _ in names.uses("ballfg/dynamics/compiled/layers.py", "tanh_all")}
    assert helpers == {"ballfg/dynamics/compiled/build.py", "ballfg/dynamics/compiled/in_c/helpers.py"}


def test_every_judged_change_is_one_that_can_still_be_made() -> None:
    for (file, before, after), reason in judged().items():
        changes = {(m.old_line, m.new_line) for m in mutations_of(file, (ROOT / file).read_bytes())}
        assert (before, after) in changes, f"{file}: {before!r} no longer becomes {after!r}; remove it"
        assert len(reason.split()) >= 3
