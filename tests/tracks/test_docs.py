"""The guide's example is run as it stands."""

import re

from ballfg.tracks import read_dataset
from tests.places import DOCS

GUIDE = DOCS / "tracks.md"


def test_the_guide_runs(tmp_path, monkeypatch, capsys):
    yaml, tracks, labels, speeds, spins, code = re.findall(
        r"```(?:yaml|csv|python)\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.S
    )
    folder = tmp_path / "my_shots"
    folder.mkdir()
    tables = {"tracks.csv": tracks, "labels.csv": labels, "speeds.csv": speeds, "spins.csv": spins}
    for name, text in {"dataset.yaml": yaml, **tables}.items():
        (folder / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(compile(code, str(GUIDE), "exec"), names)
    assert capsys.readouterr().out == "2 ['001', '002'] []\n"
    assert (tmp_path / "ranges.csv").read_text() == "trajectory,duration\n001,0.0067\n002,0.0067\n"
    assert [one.name for one in names["shots"]["001"].observations] == ["speed", "spin"]
    assert read_dataset("my_shots").track("002").labels == {"group": "unknown"}
    assert read_dataset("drops").track("drop").labels == {"group": "no spin"}
