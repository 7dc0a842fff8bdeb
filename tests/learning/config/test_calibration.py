from __future__ import annotations

from pathlib import Path

import pytest

from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.config.config_file import read_config
from tests.places import DOCS


def written(folder: Path, text: str) -> Path:
    path = folder / "config.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_defaults_overrides_and_options(tmp_path: Path) -> None:
    assert read_config(written(tmp_path, "kind: calibrate")) == CalibrationConfig()
    path = written(tmp_path, "kind: calibrate\nseed: 4\ntolerance: 0.1\n")
    words = ["tolerance=1e-3", "coefficients=[flight.drag.k]", "horizon=null", "split=label", "data=a"]
    found = read_config(path, words, {"data": "b"})
    assert isinstance(found, CalibrationConfig)
    assert (found.seed, found.tolerance, found.coefficients) == (4, 1e-3, ("flight.drag.k",))
    assert (found.horizon, found.split, found.data) == (None, "label", "b")


@pytest.mark.filterwarnings("ignore:.*is the earlier name of:DeprecationWarning")
def test_the_earlier_name_of_the_observed_share_is_read(tmp_path: Path) -> None:
    found = read_config(written(tmp_path, "kind: calibrate\nobserve: 0.3"))
    assert found == CalibrationConfig(observed_share=0.3)
    assert "observe" not in found.model_dump()
    path = written(tmp_path, "observe: 0.3")
    assert read_config(path, ["observed_share=0.5", "kind=calibrate"]) == CalibrationConfig(observed_share=0.5)
    assert read_config(path, ["kind=calibrate", "observe=0.5"]) == CalibrationConfig(observed_share=0.5)


@pytest.mark.filterwarnings("ignore:.*is the earlier name of:DeprecationWarning")
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sed: 1", "unknown key 'sed'. Did you mean 'seed'?"),
        ("zzz: 1", "unknown key 'zzz'. Known ones: kind, model, data"),
        ("seed: yes", "'seed' must be a valid integer; got True. docs/train.md lists the keys."),
        ("seed: -1", "'seed' must be greater than or equal to 0; got -1"),
        ("seed: 1.5", "'seed' must be a valid integer"),
        ("tolerance: 1e-3", "'tolerance' must be a valid number; got '1e-3'. YAML reads 1e-3 as text; write 1.0e-3."),
        ("tolerance: .nan", "'tolerance' must be a finite number"),
        ("coefficients: flight.drag.k", "'coefficients' must be a list"),
        ("coefficients: [1]", "'coefficients.0' must be a valid string; got 1"),
        ("coefficients: []", "'coefficients' must hold at least one"),
        ("split: half", "'split' must be 'random' or 'label'; got 'half'"),
        ("observed_share: 1.0", "'observed_share' must be less than 1; got 1.0"),
        ("observe: 1.0", "'observed_share' must be less than 1; got 1.0"),
        ("observe: 0.3\nobserved_share: 0.3", "'observe' is the earlier name of 'observed_share'; got both. Delete"),
        ("workers: 3", "unknown key 'workers'"),
        ("data: []", "'data' must be a folder, or a list of folders; got []"),
        ("data: [a, b]\ngroups: group\ncorrection: true", "belong to one room and ball; got several datasets"),
        ("seed: 1\nseed: 2", "'seed' stands twice"),
        ("[1, 2]", "a config maps keys to values; got [1, 2]"),
        ("seed: [", "not readable as YAML"),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, text: str, message: str) -> None:
    path = written(tmp_path, text if text[0] == "[" else f"kind: calibrate\n{text}")
    with pytest.raises(ValueError, match=r".") as error:
        read_config(path)
    assert message in str(error.value)
    assert str(error.value).startswith(str(path))


def test_bad_overrides(tmp_path: Path) -> None:
    path = written(tmp_path, "kind: calibrate")
    with pytest.raises(ValueError, match="overrides must be key=value; got 'seed'"):
        read_config(path, ["seed"])
    with pytest.raises(ValueError, match=r"with overrides: unknown key 'sed'. Did you mean 'seed'"):
        read_config(path, ["sed=1"])
    with pytest.raises(ValueError, match="not readable as YAML"):
        read_config(path, ["seed=["])
    with pytest.raises(FileNotFoundError, match="does not exist"):
        read_config(tmp_path / "none.yaml")


def test_guide_lists_every_key_with_its_default() -> None:
    guide = (DOCS / "train.md").read_text(encoding="utf-8")
    for name in CalibrationConfig.model_fields:
        assert f"| `{name}` |" in guide, name
