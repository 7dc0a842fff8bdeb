"""The guide's examples are run as they stand."""

import re

from tests.places import DOCS

GUIDE = DOCS / "predict.md"


def test_the_guide_runs(capsys):
    names = {}
    for code in re.findall(r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.S):
        exec(compile(code, str(GUIDE), "exec"), names)
    lines = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"at 0\.5 s: x = 1\.\d\d m, give or take \d+ mm", lines[0])
    assert [line.split(":")[0] for line in lines[1:4]] == ["bounce", "apex", "robot"]
    bounce, top, _ = [float(re.search(r"t = ([\d.]+) s", line)[1]) for line in lines[1:4]]
    slow, second_top = (float(time) for time in re.findall(r"t = ([\d.]+) s", lines[5]))
    assert bounce < top == second_top
    assert 0.2 < slow < 2.2
    assert lines[3].endswith(") m")
    assert "(2.00, " in lines[3]
    assert lines[4].startswith("Forecast(30 times to t = 0.500 s")
    assert re.fullmatch(r"track: 5 positions predicted, the last \d+ mm off", lines[6])
