"""docs/live.md: its example runs, and it explains every field that comes out."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from ballfg.live import Tracker
from ballfg.live.session import Session, Wanted
from ballfg.live.sources.source import Inbox, Pipe
from tests.live.shots import SURFACES, ball_model, ball_settings, rows, shots
from tests.places import DOCS

GUIDE = (DOCS / "live.md").read_text(encoding="utf-8")


def test_the_example_runs_and_the_node_is_python(capsys: pytest.CaptureFixture[str]) -> None:
    example, node = re.findall(r"```python\n(.*?)```", GUIDE, re.DOTALL)
    exec(compile(example, "live.md", "exec"), {})
    assert capsys.readouterr().out.startswith("1 OnlineState(t = 0.2900 s")
    compile(node, "live.md", "exec")


def test_every_field_is_explained(tmp_path: Path) -> None:
    lines = [",".join(map(str, row)) for row in rows(shots(1)[0])[:7].tolist()]
    (tmp_path / "in.csv").write_text("\n".join([*lines[:3], "what", *lines[3:], lines[-1]]))
    written: list[bytes] = []
    with (tmp_path / "in.csv").open("rb") as file:
        live = Tracker(ball_model(), SURFACES, ball_settings())
        session = Session(live, Inbox(Pipe(file.fileno())), written.append, Wanted(horizon=0.1))
        session.run()
    answers = [json.loads(line) for line in written]
    kinds = [answer["kind"] for answer in answers]
    assert kinds == ["newcomer"] * 2 + ["state", "refused"] + ["state"] * 4 + ["refused", "lost"]
    assert session.latencies.count == 5
    assert session.malformed == live.counts.repeated == 1
    told = GUIDE[GUIDE.index("| field |") : GUIDE.index("`--out states.mcap` writes")]
    for field in {field for answer in answers for field in answer}:
        assert f"`{field}`" in told, f"docs/live.md does not explain the field {field}"
    assert answers[2].keys() == json.loads(GUIDE.split("```json\n")[1].split("```")[0]).keys()
