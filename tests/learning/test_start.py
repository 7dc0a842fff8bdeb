"""A residual network starts from the calibrated model, and replaces it only where it surely predicts better."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from ballfg.dynamics import AnalyticModel, load_model
from ballfg.dynamics.model import BASE as PREFIX
from ballfg.dynamics.model_file import model_to_dict
from ballfg.dynamics.networks.learned import LearnedModel
from ballfg.estimation import Smoother, dataset_settings, dataset_surfaces, predict_tracks
from ballfg.learning import start
from ballfg.learning.config.training import TrainConfig
from ballfg.learning.run.training import run_training
from ballfg.learning.start import BASE, CALIBRATED, NETWORK, WITHOUT, Start, calibrated_start
from ballfg.progress import unwatched
from ballfg.tracks import read_dataset
from tests.learning.conftest import PLANTED, simulated

pytestmark = pytest.mark.usefixtures("all_networks_in_torch", "chosen_once")

SMALL = {"width_flight": 4, "width_contact": 4, "depth": 1}


def config(data: Path, rate: float) -> TrainConfig:
    given = {"data": [str(data)], "observe": {"samples": 25}, "architecture": SMALL | {"residual": True}}
    return TrainConfig.model_validate(given | {"optimizer": {"epochs": 1, "learning_rate": rate}, "jobs": 1})


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As many tracks as leave two to validate."""
    return simulated(tmp_path_factory.mktemp("start") / "data", 8)


@pytest.fixture(scope="module")
def chosen_once() -> Iterator[None]:
    """The calibration that all trainings of these tracks start from is made once."""
    real, found = start.choose_candidate, []

    def choose(*given: object) -> object:
        if not found:
            found.append(real(*given))
        return found[0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(start, "choose_candidate", choose)
        yield


@pytest.fixture(scope="module")
def refused(shots: Path, chosen_once: None, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int, str]:
    """The folder of a training whose steps are far too large, its status, and its page."""
    folder = tmp_path_factory.mktemp("refused") / "out"
    status = run_training(config(shots, 0.3), folder)
    return folder, status, (folder / "training.html").read_text(encoding="utf-8")


def test_a_network_that_gains_nothing_leaves_the_calibrated_model(refused: tuple[Path, int, str]) -> None:
    folder, status, page = refused
    assert status == 1
    written, calibrated = load_model(folder / "model.yaml"), load_model(folder / CALIBRATED)
    assert isinstance(written, AnalyticModel)
    assert isinstance(calibrated, AnalyticModel)
    assert model_to_dict(written) == model_to_dict(calibrated)
    assert "does not surely predict better than the calibrated model, which the model file holds" in page
    assert "holds the model before the first step" not in page  # one word on what the file holds
    # epoch 0, the best one, is the calibration with its doubts
    assert "the log score changes by +0.000 ± 0.000" in page
    drag = float(dict(written.named_parameters())["flight.drag.k"].detach())
    assert abs(drag - PLANTED["flight.drag.k"]) < 0.01


def test_the_comparison_is_of_predictions_by_the_written_files(refused: tuple[Path, int, str], shots: Path) -> None:
    """The errors of one model against itself, and against the same errors from `predict_tracks`."""
    folder, _, _ = refused
    data = read_dataset(shots)
    names = tuple(track.name for track in data)[:3]
    judge = Start(folder / CALIBRATED, folder / BASE, data, names, config(shots, 0.1).observe)
    choice = judge.compare(folder / CALIBRATED)
    assert choice is not None
    assert choice.chosen == WITHOUT
    assert choice.candidates[1].gain == 0.0
    model = load_model(folder / CALIBRATED)
    smoother = Smoother(model, dataset_surfaces(data), dataset_settings(data, model))
    tracks = [track for track in data if track.name in names]
    found = predict_tracks(smoother, tracks, 3, lambda track: float(track.seconds[24]), horizon=0.3)
    errors = [float(np.sqrt(((one.positions - one.measured) ** 2).sum(axis=1).mean())) for one in found]
    assert choice.candidates[0].rmse_median == pytest.approx(np.median(errors), rel=1e-9)


def test_one_that_gains_carries_the_population(shots: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its file states the noise and the spreads of the calibrated one; another room has its own."""

    def gains(judge: Start, network: Path) -> object:
        choice = real(judge, network)
        assert choice is not None
        return choice.model_copy(update={"chosen": NETWORK})

    real = Start.compare
    monkeypatch.setattr(Start, "compare", gains)
    run_training(config(shots, 1e-4), tmp_path / "out")
    found, base = load_model(tmp_path / "out" / "model.yaml"), load_model(tmp_path / "out" / BASE)
    assert isinstance(found, LearnedModel)
    assert base.noise is not None
    assert found.noise is not None
    data = read_dataset(shots)
    own, right = dataset_settings(data, found), dataset_settings(data, base)
    assert own.process == right.process
    assert own.coefficients == {f"{PREFIX}{name}": sigma for name, sigma in right.coefficients.items()}
    assert own.spins == right.spins
    state = torch.tensor([[0.0, 0.0, 1.0, 4.0, 1.0, 2.0, 10.0, 60.0, 20.0]], dtype=torch.float64)
    torch.testing.assert_close(found.rates(state)[0], base.rates(state)[0], atol=0.2, rtol=0.0)


def test_what_has_no_start(shots: Path, tmp_path: Path) -> None:
    alone = config(shots, 0.1).model_copy(update={"data": (str(shots), str(shots))})
    assert calibrated_start(alone, tmp_path, resume=False, watch=unwatched) is None
    plain = TrainConfig.model_validate({"data": [str(shots)], "observe": {"samples": 25}})
    assert calibrated_start(plain, tmp_path, resume=False, watch=unwatched) is None


def test_without_a_judged_track_the_calibrated_model_stays(refused: tuple[Path, int, str], shots: Path) -> None:
    folder, _, _ = refused
    given = (read_dataset(shots), (), config(shots, 0.1).observe)
    assert Start(folder / CALIBRATED, folder / BASE, *given).compare(folder / CALIBRATED) is None
