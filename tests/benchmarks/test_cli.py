import json
from pathlib import Path

import pytest

from ballfg.benchmarks.cli import run
from ballfg.simulation import SimulationConfig, write_simulation


def invoke(*words: str) -> int:
    with pytest.raises(SystemExit) as ended:
        run(list(words))
    assert isinstance(ended.value.code, int)
    return ended.value.code


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "tiny"
    write_simulation(folder, SimulationConfig(tracks=4, seed=1))
    return folder


def test_help_has_commands_and_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    assert invoke("--help") == 0
    listed = capsys.readouterr().out
    assert "estimators" in listed
    assert "speed" in listed
    assert invoke("estimators", "--help") == 0
    assert "ballfg-bench estimators --data" in " ".join(capsys.readouterr().out.split())


def test_help_does_not_wait_for_torch() -> None:
    import subprocess
    import sys

    code = "import ballfg.benchmarks.cli, sys; sys.exit('torch' in sys.modules or 'gtsam' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_measured_run_writes_rows_and_pictures(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert invoke("estimators", "--data", str(dataset), "--out", str(out), "--quick", "--jobs", "1") == 0
    content = json.loads((out / "results.json").read_text())
    assert content["command"] == "ballfg-bench estimators --data tiny --quick --seed 0"
    rows = {(row["method"], row["metric"]): row for row in content["rows"]}
    name = "simulated table-tennis"
    assert {row["case"] for row in content["rows"]} == {name}
    for method in ("smoother", "online", "ekf", "sliding-window"):
        row = rows[method, "prediction_rmse_median"]
        assert row["unit"] == "mm"
        assert row["n"] == 4
        assert row["low"] <= row["value"] <= row["high"]
        assert 0.0 <= rows[method, "coverage_90"]["value"] <= 1.0
    # a sensible estimator stays within centimetres on its own simulation
    assert rows["smoother", "prediction_rmse_median"]["value"] < 60.0
    printed = capsys.readouterr().out
    assert "prediction_rmse_median" in printed
    for picture in ("growth", "calibration", "tracks"):
        path = out / f"{picture}_simulated-table-tennis.png"
        assert path.read_bytes().startswith(b"\x89PNG")
        assert str(path) in printed


@pytest.mark.parametrize("command", ["estimators", "speed"])
def test_missing_dataset_is_one_line_and_status_2(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert invoke(command, "--data", "no/such/folder", "--out", "never") == 2
    captured = capsys.readouterr()
    assert captured.err.strip().count("\n") == 0
    assert "no/such/folder" in captured.err
    assert not Path("never").exists()


def test_out_that_is_a_file_is_refused(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert invoke("estimators", "--data", str(dataset), "--out", str(tmp_path / "file")) == 2
    assert "--out must be a folder" in capsys.readouterr().err


def test_negative_seed_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert invoke("estimators", "--seed", "-1") == 2
    assert "--seed" in capsys.readouterr().err
