"""A package of somebody else, installed beside this one: its effect, observation and estimator take part everywhere."""

from __future__ import annotations

import csv
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from ballfg.estimation import read
from ballfg.simulation import MeasurementNoise, SimulationConfig, write_simulation
from tests.commands import status
from tests.interpreter import Answer, Interpreter
from tests.places import DOCS

EFFECT = re.findall(r"```python\n(.*?)```", (DOCS / "add_an_effect.md").read_text(encoding="utf-8"), re.DOTALL)[0]
OBSERVATION = '''
"""A laser above the table tells the height of the ball."""

from ballfg.estimation import Reading


class LaserHeight(Reading):
    """The height of the ball, m."""

    name = "height"
    file = "heights.csv"
    columns = ("height",)

    def predicted(self, state):
        """(..., 1) m."""
        return state[..., 2:3]
'''
ESTIMATOR = '''
"""The filter of ballfg with a backward pass, under a name of its own."""

from ballfg.estimation import ExtendedKalmanFilter


class BackAndForth(ExtendedKalmanFilter):
    """There and back again."""

    name = "back-and-forth"

    def __init__(self, model, surfaces, settings=None):
        super().__init__(model, surfaces, settings, smooth=True)
'''
POINTS = """
[ballfg.effects]
static_charge = ball_lab.effect:StaticCharge
[ballfg.observations]
height = ball_lab.observation:LaserHeight
[ballfg.estimators]
back-and-forth = ball_lab.estimator:BackAndForth
"""


SMALL_RUN = """
from pathlib import Path
from ballfg.benchmarks.estimators.suite import Size, run_synthetic
from ballfg.benchmarks.results import Results

def run(words):
    results = Results("test", 2)
    run_synthetic(results, Path(words[0]), Size(compared=2, consistency=2, measured=None, counts=(5, 10)), 1)
    print(*{(row.case, row.method): row.value for row in results.rows if row.metric == "velocity_rmse"}.items())
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of installed packages with `ball-lab` in it, files as pip leaves them."""
    folder = tmp_path_factory.mktemp("site")
    package, info = folder / "ball_lab", folder / "ball_lab-0.3.dist-info"
    package.mkdir()
    info.mkdir()
    for name, text in (("effect", EFFECT), ("observation", OBSERVATION), ("estimator", ESTIMATOR), ("__init__", "")):
        (package / f"{name}.py").write_text(text, encoding="utf-8")
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: ball-lab\nVersion: 0.3\n", encoding="utf-8")
    (info / "entry_points.txt").write_text(POINTS, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three measured tracks, and a laser that saw their heights better than the cameras did."""
    folder = tmp_path_factory.mktemp("measured") / "shots"
    write_simulation(folder, SimulationConfig(3, 100.0, seed=4, noise=MeasurementNoise(position=0.004)))
    with (folder / "truth.csv").open(encoding="utf-8") as file:
        truth = list(csv.DictReader(file))
    rng = np.random.default_rng(0)
    lines = [
        f"{row['trajectory']},{row['t']},{float(row['z']) + 3e-4 * rng.standard_normal():.6f},3e-4" for row in truth
    ]
    (folder / "heights.csv").write_text("\n".join(["trajectory,t,height,sigma", *lines]) + "\n", encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def with_package(site: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Interpreter]:
    """An interpreter that finds the package; this one does not."""
    small_run = tmp_path_factory.mktemp("code") / "small_run.py"
    small_run.write_text(SMALL_RUN, encoding="utf-8")
    with Interpreter([site, small_run.parent]) as interpreter:
        yield interpreter


def printed(answer: Answer) -> str:
    """What a command prints that must end well."""
    assert answer.status == 0, answer.err
    return answer.out


def column(path: Path, name: str) -> np.ndarray:
    with path.open(encoding="utf-8") as file:
        return np.array([float(row[name]) for row in csv.DictReader(file)])


def test_info_lists_what_the_package_adds(with_package: Interpreter, capsys: pytest.CaptureFixture[str]) -> None:
    sections = dict(re.findall(r"^(\w+)\n((?:  .*\n)+)", printed(with_package("info")), re.MULTILINE))
    assert "  ball-lab 0.3: static_charge\n" in sections["effects"]
    assert "  ball-lab 0.3: height\n" in sections["observations"]
    assert "  ball-lab 0.3: back-and-forth\n" in sections["estimators"]
    assert ": position, sighting, speed, spin\n" in sections["observations"]
    assert ": a-tune, mlp, mlp+gs, skip+gs, mnn+gs, lstm, diffusion\n" in sections["trainees"]
    assert status("info") == 0
    assert "ball-lab" not in capsys.readouterr().out


def test_estimate_uses_its_observation_and_its_estimator(
    with_package: Interpreter, shots: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the laser heights are five times better; the package's estimator smooths, and sees the laser as well."""

    def here(*words: object) -> str:
        assert status(*words) == 0
        return capsys.readouterr().out

    def there(*words: object) -> str:
        return printed(with_package(*words))

    truth = column(shots / "truth.csv", "z")
    bare = shutil.copytree(shots, tmp_path / "bare")
    (bare / "heights.csv").unlink()
    error, sigma = {}, {}
    for name, ballfg, method in (
        ("plain", here, "smoother"),
        ("laser", there, "smoother"),
        ("own", there, "back-and-forth"),
        ("filter", here, "ekf"),
    ):
        out = tmp_path / f"{name}.csv"
        said = ballfg("estimate", bare if ballfg is here else shots, "--method", method, "--out", out, "--jobs", 2)
        assert f"by {method}" in said
        error[name] = np.sqrt(np.mean((column(out, "z") - truth) ** 2))
        sigma[name] = np.median(column(out, "sigma_z"))
    assert error["laser"] < 0.5 * error["plain"]
    assert sigma["laser"] < 0.5 * sigma["plain"]
    assert error["own"] < 0.5 * error["plain"] < error["filter"]
    assert sigma["own"] == pytest.approx(sigma["laser"], rel=0.1)


def test_an_unknown_method_is_told_of_those_there_are(with_package: Interpreter, shots: Path, tmp_path: Path) -> None:
    answer = with_package("estimate", shots, "--method", "guess", "--out", tmp_path / "out.csv")
    assert answer.status == 2
    assert "smoother, online, ekf, sliding-window, back-and-forth; got 'guess'" in answer.err


@pytest.mark.thorough
def test_diagnose_finds_its_effect(with_package: Interpreter, tmp_path: Path) -> None:
    """Charged balls, simulated, searched and found with nothing named but the effect to plant."""
    charged, found = tmp_path / "charged", tmp_path / "diagnosis"
    simulated = ("simulate", "--out", charged, "--tracks", 8, "--rate", 100, "--effect", "static_charge.strength=4")
    assert "undeclared effects: static_charge" in printed(with_package(*simulated))
    printed(with_package("diagnose", charged, "--out", found, "--jobs", 1))
    report = json.loads((found / "report.json").read_text(encoding="utf-8"))
    assert "static_charge" in {hypothesis["name"] for hypothesis in report["rounds"][0]}
    assert [effect["name"] for effect in report["effects"]] == ["static_charge"]


def test_the_benchmark_on_measured_tracks_has_its_rows(with_package: Interpreter, shots: Path, tmp_path: Path) -> None:
    words = ("estimators", "--data", shots, "--quick", "--out", tmp_path / "results", "--jobs", 1)
    printed(with_package(*words, function="ballfg.benchmarks.cli:run"))
    rows = json.loads((tmp_path / "results" / "results.json").read_text(encoding="utf-8"))["rows"]
    scored = {row["method"]: row["value"] for row in rows if row["metric"] == "prediction_rmse_median"}
    assert list(scored) == ["smoother", "online", "ekf", "sliding-window", "back-and-forth"]
    assert scored["back-and-forth"] == pytest.approx(scored["ekf"], rel=1e-6)  # at the newest sample the pass is over


@pytest.mark.thorough  # a quicker one: on measured tracks
def test_the_benchmark_on_simulated_tracks_has_its_rows(with_package: Interpreter, tmp_path: Path) -> None:
    """The suite of `ballfg-bench estimators --quick` with fewer tracks."""
    said = printed(with_package(tmp_path, function="small_run:run"))
    for case in ("paper", "fair"):
        (own,) = re.findall(rf"\(\('{case}', 'back-and-forth'\), ([\d.]+)\)", said)
        (smoother,) = re.findall(rf"\(\('{case}', 'smoother'\), ([\d.]+)\)", said)
        assert float(own) == pytest.approx(float(smoother), rel=0.2)


def test_without_the_package_its_table_is_refused(shots: Path) -> None:
    with pytest.raises(ValueError, match=r"heights\.csv must belong to an observation"):
        read(shots)
