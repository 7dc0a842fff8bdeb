"""The guide's example is run as it stands."""

import re

from tests.places import DOCS

GUIDE = DOCS / "predict.md"


def test_the_guide_runs(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.S)
    exec(compile(code, str(GUIDE), "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"at 0\.5 s: x = 1\.\d\d m, give or take \d+ mm", lines[0])
    assert [line.split(":")[0] for line in lines[1:]] == ["bounce", "apex", "robot"]
    times = [float(re.search(r"t = ([\d.]+) s", line)[1]) for line in lines[1:]]
    assert times[0] < times[1]
    assert lines[3].endswith(") m")
    assert "(2.00, " in lines[3]
