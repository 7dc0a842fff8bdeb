"""A package of somebody else, installed beside this one: its effect, observation and estimator take part everywhere."""

from __future__ import annotations

import csv
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ballfg.estimation import read
from ballfg.simulation import MeasurementNoise, SimulationConfig, write_simulation
from tests.places import DOCS

ROOT = Path(__file__).parents[1]
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


def ballfg(site: Path | None, *words: object, module: str = "ballfg.cli.main", entry: str = "run") -> str:
    """What a command prints in an interpreter of its own that finds the packages of a folder."""
    path = os.pathsep.join(str(folder) for folder in (site, ROOT) if folder is not None)
    code = f"from {module} import {entry}\n{entry}({[str(word) for word in words]})"
    environment = {**os.environ, "PYTHONPATH": path}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def bench(site: Path | None, *words: object) -> str:
    return ballfg(site, *words, module="ballfg.benchmarks.cli")


def column(path: Path, name: str) -> np.ndarray:
    with path.open(encoding="utf-8") as file:
        return np.array([float(row[name]) for row in csv.DictReader(file)])


def test_info_lists_what_the_package_adds(site: Path) -> None:
    sections = dict(re.findall(r"^(\w+)\n((?:  .*\n)+)", ballfg(site, "info"), re.MULTILINE))
    assert "  ball-lab 0.3: static_charge\n" in sections["effects"]
    assert "  ball-lab 0.3: height\n" in sections["observations"]
    assert "  ball-lab 0.3: back-and-forth\n" in sections["estimators"]
    assert ": position, sighting, speed, spin\n" in sections["observations"]
    assert ": a-tune, mlp, mlp+gs, skip+gs, mnn+gs, lstm, diffusion\n" in sections["trainees"]
    assert "ball-lab" not in ballfg(None, "info")


def test_estimate_uses_its_observation_and_its_estimator(site: Path, shots: Path, tmp_path: Path) -> None:
    """With the laser heights are five times better; the package's estimator smooths, and sees the laser as well."""
    truth = column(shots / "truth.csv", "z")
    error, sigma = {}, {}
    for name, packages, method in (
        ("plain", None, "smoother"),
        ("laser", site, "smoother"),
        ("own", site, "back-and-forth"),
        ("filter", None, "ekf"),
    ):
        out = tmp_path / f"{name}.csv"
        said = ballfg(packages, "estimate", shots, "--method", method, "--out", out, "--jobs", 2)
        assert f"by {method}" in said
        error[name] = np.sqrt(np.mean((column(out, "z") - truth) ** 2))
        sigma[name] = np.median(column(out, "sigma_z"))
    assert error["laser"] < 0.5 * error["plain"]
    assert sigma["laser"] < 0.5 * sigma["plain"]
    assert error["own"] < 0.5 * error["plain"] < error["filter"]
    assert sigma["own"] == pytest.approx(sigma["laser"], rel=0.1)


def test_an_unknown_method_is_told_of_those_there_are(site: Path, shots: Path, tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="smoother, online, ekf, sliding-window, back-and-forth; got 'guess'"):
        ballfg(site, "estimate", shots, "--method", "guess", "--out", tmp_path / "out.csv")


@pytest.mark.slow
def test_diagnose_finds_its_effect(site: Path, tmp_path: Path) -> None:
    """Charged balls, simulated, searched and found with nothing named but the effect to plant."""
    charged, found = tmp_path / "charged", tmp_path / "diagnosis"
    simulated = ("simulate", "--out", charged, "--tracks", 8, "--rate", 100, "--effect", "static_charge.strength=4")
    assert "undeclared effects: static_charge" in ballfg(site, *simulated)
    ballfg(site, "diagnose", charged, "--out", found, "--jobs", 1)
    report = json.loads((found / "report.json").read_text(encoding="utf-8"))
    assert "static_charge" in {hypothesis["name"] for hypothesis in report["rounds"][0]}
    assert [effect["name"] for effect in report["effects"]] == ["static_charge"]


def test_the_benchmark_on_measured_tracks_has_its_rows(site: Path, shots: Path, tmp_path: Path) -> None:
    bench(site, "estimators", "--data", shots, "--quick", "--out", tmp_path / "results", "--jobs", 1)
    rows = json.loads((tmp_path / "results" / "results.json").read_text(encoding="utf-8"))["rows"]
    scored = {row["method"]: row["value"] for row in rows if row["metric"] == "prediction_rmse_median"}
    assert list(scored) == ["smoother", "online", "ekf", "sliding-window", "back-and-forth"]
    assert scored["back-and-forth"] == pytest.approx(scored["ekf"], rel=1e-6)  # at the newest sample the pass is over


SMALL_RUN = """
from pathlib import Path
from ballfg.benchmarks.estimators.suite import Size, run_synthetic
from ballfg.benchmarks.results import Results

def run(words):
    results = Results("test", 2)
    run_synthetic(results, Path(words[0]), Size(compared=2, consistency=2, measured=None, counts=(5, 10)), 1)
    print(*{(row.case, row.method): row.value for row in results.rows if row.metric == "velocity_rmse"}.items())
"""


def test_the_benchmark_on_simulated_tracks_has_its_rows(site: Path, tmp_path: Path) -> None:
    """The suite of `ballfg-bench estimators --quick` with fewer tracks."""
    (tmp_path / "small_run.py").write_text(SMALL_RUN, encoding="utf-8")
    paths = os.pathsep.join(map(str, (site, tmp_path)))
    said = ballfg(Path(paths), tmp_path, module="small_run")
    for case in ("paper", "fair"):
        (own,) = re.findall(rf"\(\('{case}', 'back-and-forth'\), ([\d.]+)\)", said)
        (smoother,) = re.findall(rf"\(\('{case}', 'smoother'\), ([\d.]+)\)", said)
        assert float(own) == pytest.approx(float(smoother), rel=0.2)


def test_without_the_package_its_table_is_left_alone(shots: Path) -> None:
    assert not any(track.observations for track in read(shots))
