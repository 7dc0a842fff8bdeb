"""A benchmark goes on with a training that was stopped, although it has left its best model so far."""

from pathlib import Path

from ballfg.benchmarks.dynamics.trained import _finished
from ballfg.learning.config.training import OptimizerConfig, TrainConfig
from ballfg.learning.run.run_folder import Epoch, write_metrics


def test_a_stopped_training_is_not_finished(tmp_path: Path) -> None:
    config = TrainConfig(kind="mlp", optimizer=OptimizerConfig(epochs=2))
    rows = [Epoch(i, None, None, 0.05, 1e-3, None, 0, 0, 0, 1.0) for i in range(3)]
    assert not _finished(tmp_path, config)
    write_metrics(tmp_path / "metrics.csv", rows)
    assert not _finished(tmp_path, config)
    (tmp_path / "model.yaml").write_text("{}")
    assert _finished(tmp_path, config)
    write_metrics(tmp_path / "metrics.csv", rows[:2])
    assert not _finished(tmp_path, config)
