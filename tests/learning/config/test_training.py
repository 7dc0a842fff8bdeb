from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import BaseModel

from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.config.config_file import checked_config, read_config
from ballfg.learning.config.training import LossConfig, TrainConfig
from tests.places import DOCS


def written(folder: Path, text: str) -> Path:
    path = folder / "train.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_an_empty_file_is_the_default_training(tmp_path: Path) -> None:
    found = read_config(written(tmp_path, ""))
    assert found == TrainConfig()
    assert isinstance(found, TrainConfig)
    assert (found.kind, found.observe.samples, found.observe.seconds) == ("mnn+gs", 80, None)


def test_the_resolved_config_reads_back_as_itself(tmp_path: Path) -> None:
    words = {
        "data": ["a", "b"],
        "observe": {"seconds": 0.25},
        "launcher": {"labels": ["topspin"]},
        "noise": {"spin": 2},
    }
    found = checked_config(words, "here")
    text = yaml.safe_dump(found.model_dump(mode="json"))
    assert read_config(written(tmp_path, text)) == found


def test_overrides_reach_into_sections(tmp_path: Path) -> None:
    path = written(tmp_path, "optimizer: {learning_rate: 0.1, epochs: 3}\ndata: a\n")
    words = [
        "optimizer.learning_rate=1e-4",
        "loss.horizon=0.5",
        "kind=skip+gs",
        "observe={seconds: 0.3}",
        "data=[b, c]",
    ]
    found = read_config(path, words)
    assert isinstance(found, TrainConfig)
    assert (found.optimizer.learning_rate, found.optimizer.epochs, found.loss.horizon) == (1e-4, 3, 0.5)
    assert (found.kind, found.observe.seconds, found.observe.samples) == ("skip+gs", 0.3, None)
    assert found.data == ("b", "c")
    assert TrainConfig(data="d").data == ("d",)


@pytest.mark.filterwarnings("ignore:.*is the earlier name of:DeprecationWarning")
@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "optimizer: {learning_rat: 1}",
            "unknown key 'optimizer.learning_rat'. Did you mean 'optimizer.learning_rate'?",
        ),
        ("optimizer: {zzz: 1}", "unknown key 'optimizer.zzz'. Known ones: optimizer.learning_rate, optimizer.schedule"),
        ("learning_rate: 1.0", "unknown key 'learning_rate'. Did you mean 'optimizer.learning_rate'?"),
        ("coefficients: []", "unknown key 'coefficients'. It is a key of a calibration: write 'kind: calibrate'."),
        ("kindd: mlp", "unknown key 'kindd'. Did you mean 'kind'?"),
        ("kind: mn+gs", "'diffusion'"),
        ("kind: mn+gs", "; got 'mn+gs'. To calibrate coefficients write 'kind: calibrate'."),
        ("optimizer: 3", "'optimizer' must be a section with keys; got 3. Its keys: learning_rate, schedule"),
        ("optimizer: {clip: 1e-3}", "'optimizer.clip' must be a valid number; got '1e-3'. YAML reads 1e-3 as text"),
        ("optimizer: {clip: .nan}", "'optimizer.clip' must be a finite number; got nan. docs/train.md lists"),
        ("optimizer: {clip: nan}", "'optimizer.clip' must be a finite number; got 'nan'. docs/train.md lists"),
        ("loss: {likelihood: -inf}", "'loss.likelihood' must be a finite number; got '-inf'. docs/train.md lists"),
        ("architecture: {depth: 50}", "'architecture.depth' must be less than or equal to 20; got 50."),
        ("architecture: {width_flight: 1000000}", "'architecture.width_flight' must be less than or equal to 2048;"),
        ("architecture: {width_contact: 3000}", "'architecture.width_contact' must be less than or equal to 2048;"),
        ("jobs: 100000", "'jobs' must be less than or equal to 10000; got 100000."),
        ("{kind: calibrate, jobs: 100000}", "'jobs' must be less than or equal to 10000; got 100000."),
        ("optimizer: {epochs: 0}", "'optimizer.epochs' must be greater than or equal to 1; got 0"),
        ("optimizer: {epochs: 3, epochs: 4}", "'optimizer.epochs' stands twice. Delete one of them."),
        ("augment: 1", "'augment' must be a valid boolean; got 1"),
        ("data: []", "'data' must hold at least one; got []"),
        ("data: 3", "'data' must be a list; got 3"),
        ("observe: {samples: 20, seconds: 0.3}", "'observe' must have exactly one of samples and seconds"),
        ("observe: -0.3", "'observe.seconds' must be greater than 0; got -0.3"),
        ("observe: true", "'observe' must be seconds, or a section with samples or seconds; got True. Write 0.25."),
        ("observe: soon", "'observe' must be seconds, or a section with samples or seconds; got 'soon'. Write 0.25."),
        ("{jobs: 2, workers: 2}", "'workers' is the earlier name of 'jobs'; got both. Delete 'workers'."),
        ("workers: 0", "'jobs' must be greater than or equal to 1; got 0"),
        ("observe: {samples: null}", "'observe' must have exactly one of samples and seconds"),
        ("{kind: lstm, model: a.yaml}", "'model' plays no part in kind 'lstm'. Leave it out."),
        ("{kind: lstm, gradient: unrolled}", "'gradient' plays no part in kind 'lstm'. Leave it out."),
        ("{kind: diffusion, loss: {horizon: 0.3}}", "'loss' plays no part in kind 'diffusion'. Leave it out."),
        ("{kind: lstm, launcher: {start: tracks}}", "'launcher.start' plays no part in kind 'lstm'. Leave it out."),
        ("{kind: lstm, optimizer: {noise_step: 2.0}}", "'optimizer.noise_step' plays no part in kind 'lstm'."),
        ("{kind: a-tune, architecture: {depth: 3}}", "'architecture' plays no part in kind 'a-tune'. Leave it out."),
        ("split: {validation: 1.0}", "'split.validation' must be less than 1; got 1.0"),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, text: str, message: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ValueError, match=r".") as error:
        read_config(path)
    assert message in str(error.value)
    assert str(error.value).startswith(f"{path}: ")


def test_a_number_to_observe_is_seconds(tmp_path: Path) -> None:
    for text, words in (
        ("observe: 0.3", ()),
        ("observe: {samples: 40}", ("observe=0.3",)),
        ("observe: 2", ("observe=0.3",)),
    ):
        found = read_config(written(tmp_path, text), words)
        assert isinstance(found, TrainConfig)
        assert found == TrainConfig.model_validate({"observe": {"seconds": 0.3}})
        assert read_config(written(tmp_path, yaml.safe_dump(found.model_dump(mode="json")))) == found
    found = read_config(written(tmp_path, "observe: 0.3"), ["observe.samples=40"])
    assert isinstance(found, TrainConfig)
    assert (found.observe.samples, found.observe.seconds) == (40, None)


@pytest.mark.filterwarnings("ignore:.*is the earlier name of:DeprecationWarning")
def test_the_earlier_name_of_jobs_is_read(tmp_path: Path) -> None:
    path = written(tmp_path, "workers: 3")
    with pytest.warns(DeprecationWarning, match="'workers' is the earlier name of 'jobs'.* Write 'jobs'"):
        read_config(path)
    assert read_config(path) == checked_config({"workers": 3}, "here") == TrainConfig(jobs=3)
    assert "workers" not in read_config(path).model_dump()
    for name in ("jobs", "workers"):
        for text in ("workers: 3", "jobs: 3", ""):
            assert read_config(written(tmp_path, text), [f"{name}=2"]) == TrainConfig(jobs=2)
    with pytest.raises(ValueError, match=r"^here: 'workers' is the earlier name of 'jobs'; got both"):
        checked_config({"workers": 3, "jobs": 3}, "here")


def test_bad_overrides_name_the_nested_key(tmp_path: Path) -> None:
    path = written(tmp_path, "")
    with pytest.raises(ValueError, match=r"unknown key 'optimizer.rate'"):
        read_config(path, ["optimizer.rate=1"])
    with pytest.raises(ValueError, match=r"overrides must be key=value; got 'optimizer.=1'"):
        read_config(path, ["optimizer.=1"])
    with pytest.raises(ValueError, match=r"'seed' must be a valid integer"):
        read_config(path, ["seed.a=1"])


def test_parts_that_play_a_part_are_taken() -> None:
    found = checked_config({"kind": "mlp+gs", "model": "a.yaml", "architecture": {"residual": True}}, "here")
    assert found.model == "a.yaml"
    assert checked_config({"kind": "a-tune", "model": "a.yaml"}, "here").model == "a.yaml"


@pytest.mark.parametrize(
    ("kind", "augmented"), [("a-tune", True), ("mlp", True), ("mlp+gs", False), ("mnn+gs", False), ("lstm", True)]
)
def test_augmentation_is_the_default_where_symmetry_is_not_built_in(kind: Any, augmented: bool) -> None:
    assert TrainConfig(kind=kind).augmented is augmented
    assert TrainConfig(kind=kind, augment=not augmented).augmented is not augmented


def test_the_horizon_grows_to_its_full_length() -> None:
    loss = LossConfig(horizon=1.1, horizon_start=0.3, horizon_epochs=4)
    assert [loss.horizon_at(epoch, 5.0) for epoch in range(6)] == pytest.approx([0.3, 0.5, 0.7, 0.9, 1.1, 1.1])
    assert loss.horizon_at(1, 0.2) == 0.2  # the track ends before
    assert LossConfig().horizon_at(0, 5.0) == 5.0


def leaves(config: type[BaseModel], prefix: str = "") -> list[str]:
    found = []
    for name, field in config.model_fields.items():
        section = isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)
        found += leaves(field.annotation, f"{prefix}{name}.") if section else [prefix + name]
    return found


def test_guide_lists_every_key() -> None:
    guide = (DOCS / "train.md").read_text(encoding="utf-8")
    for name in leaves(TrainConfig):
        assert f"| `{name}` |" in guide, name


def test_fields_that_may_change_on_resume_exist() -> None:
    assert set(TrainConfig.FREE_TO_CHANGE) <= set(leaves(TrainConfig))


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
def test_what_is_wrong_with_a_calibration_is_said(tmp_path: Path, text: str, message: str) -> None:
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
