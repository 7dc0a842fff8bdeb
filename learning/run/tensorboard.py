"""The numbers of a training as TensorBoard shows them: `tensorboard --logdir OUT/tensorboard`."""

from __future__ import annotations

from pathlib import Path

from torch.utils.tensorboard import SummaryWriter

from ballfg.learning.run.metrics import Epoch

SCALARS = {
    "loss/train": "loss",
    "rmse_mm/train": "train_rmse",
    "rmse_mm/validation": "validation_rmse",
    "optimizer/learning_rate": "learning_rate",
    "optimizer/gradient_norm": "gradient_norm",
    "tracks/failed": "failed",
    "tracks/validation_failed": "validation_failed",
    "steps/skipped": "skipped",
    "time/seconds": "seconds",
}
"""Name of each curve and the number of an epoch that it shows; RMSE in mm."""


class Events:
    """Writes event files as the epochs come."""

    def __init__(self, folder: Path, begun: int) -> None:
        """Args: folder: of the event files.  begun: first epoch that follows; what an earlier run wrote of it goes."""
        self._writer = SummaryWriter(str(folder), purge_step=begun)

    def write(self, epoch: Epoch) -> None:
        """One point on every curve that has one; it is on the disk afterwards."""
        for name, attribute in SCALARS.items():
            value = getattr(epoch, attribute)
            if value is not None:
                scale = 1e3 if name.startswith("rmse_mm") else 1.0
                self._writer.add_scalar(name, scale * value, epoch.epoch)
        self._writer.flush()

    def close(self) -> None:
        """Close the event file."""
        self._writer.close()
