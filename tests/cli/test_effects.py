"""`--effects-file FILE.py` as a user meets it: an effect of one's own in simulations, model files and searches."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

import ballfg.diagnosis
from ballfg.dynamics import EFFECTS
from tests.commands import printed, refused, status
from tests.places import DOCS

GUIDE = DOCS / "add_an_effect.md"


@pytest.fixture(autouse=True)
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with the guide's effect; what a command registers is forgotten."""
    monkeypatch.chdir(tmp_path)
    code = re.findall(r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)[0]
    Path("static_charge.py").write_text(code, encoding="utf-8")
    with EFFECTS.restored():
        yield tmp_path


def test_the_guides_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    """As they stand there, with fewer tracks; the search itself is tested elsewhere."""
    asked = []

    def diagnose(dataset: object, model: object, **options: object) -> None:
        asked.append(list(EFFECTS))
        raise ValueError("enough")

    monkeypatch.setattr(ballfg.diagnosis, "diagnose", diagnose)
    commands = re.findall(r"^ballfg (.*--effects-file .*)$", GUIDE.read_text(encoding="utf-8"), re.MULTILINE)
    simulate, search, predict = (command.replace("--tracks 50", "--tracks 2").split() for command in commands)
    with EFFECTS.restored():
        assert "undeclared effects: static_charge" in printed(*simulate).out
    assert yaml.safe_load(Path("charged/truth.yaml").read_text(encoding="utf-8"))
    with EFFECTS.restored():
        assert status(*search) == 2
    assert asked[0][-1] == "static_charge"
    assert "static_charge" not in EFFECTS
    model = yaml.safe_load(Path("charged/model.yaml").read_text(encoding="utf-8"))
    model["flight"]["static_charge"] = {"strength": 2.0}
    Path("diagnosis").mkdir()
    Path("diagnosis/model.yaml").write_text(yaml.safe_dump(model), encoding="utf-8")
    assert status(*predict) == 0
    assert Path("predictions.csv").is_file()


def test_a_model_file_that_names_an_unknown_effect_is_refused() -> None:
    assert status("simulate", "--out", "plain", "--tracks", 2) == 0
    Path("model.yaml").write_text("flight: {gravity: {}, static_charge: {strength: 1.0}}\nbounce: {}\n")
    arguments = ("estimate", "plain", "--model", "model.yaml", "--out", "states.csv")
    said = refused(*arguments)
    assert said.startswith("ballfg: error: model.yaml: there is no flight effect 'static_charge'; known ones: ")
    assert said.endswith("must be registered first: --effects-file FILE.py, or ballfg.dynamics.register.\n")
    assert not Path("states.csv").exists()
    assert status(*arguments, "--effects-file", "static_charge.py", "--effects-file", "static_charge.py") == 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "broken.py does not exist; effects of one's own are one Python file."),
        ("import nowhere_at_all", "line 1: ModuleNotFoundError: No module named 'nowhere_at_all'. Mend it there."),
        ("x = 1", "must define an effect, a class; it defines none. docs/add_an_effect.md has an example."),
    ],
)
def test_bad_files_are_one_line_and_status_2(text: str | None, message: str) -> None:
    if text is not None:
        Path("broken.py").write_text(text, encoding="utf-8")
    assert refused("simulate", "--out", "d", "--effects-file", "broken.py").endswith(f"{message}\n")
    assert not Path("d").exists()


@pytest.mark.parametrize("words", [("--effects", "static_charge.py"), ("--effects=static_charge.py",)])
def test_the_earlier_name_of_the_option_works(words: tuple[str, ...]) -> None:
    """Also beside the name of today and beside `--effect`, which names an effect. Help shows only the name of today."""
    simulated = ("simulate", "--tracks", 2, "--effect", "static_charge.strength=2")
    for options in (("--out", "earlier", *words), ("--out", "both", *words, "--effects-file", "static_charge.py")):
        assert "undeclared effects: static_charge" in printed(*simulated, *options).out
    for command in ("estimate", "predict", "diagnose", "simulate", "render"):
        said = printed(command, "--help").out
        assert "--effects-file" in said
        assert not re.search(r"--effects(?!-file)", said)


def test_all_that_is_known_of_an_effect_is_told() -> None:
    lines = printed("effects").out.splitlines()
    assert [line.split()[0] for line in lines] == list(EFFECTS)
    said = " ".join(printed("effects", "wind", "drag_speed").out.split())
    for effect in (EFFECTS["wind"], EFFECTS["drag_speed"]):
        for words in (effect.sentence, effect.decide, effect.plain, effect.usual.source, effect.plausible.source):
            assert words in said
    assert "needs: drag" in said
    assert "there is no effect 'wnd'" in refused("effects", "wnd")
