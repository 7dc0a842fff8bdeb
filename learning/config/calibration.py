"""What a calibration is told; each field with its meaning."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field


class CalibrationConfig(BaseModel):
    """A whole calibration. The same config on the same data gives the same numbers.

    Paths are relative to the folder in which the command runs.
    """

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)

    FREE_TO_CHANGE: ClassVar[tuple[str, ...]] = ("out", "data", "model", "max_iterations", "tolerance", "jobs")
    """Fields that a resumed run may change: they move no number, or are checked by content (data, model)."""

    kind: Literal["calibrate"] = "calibrate"
    """Tells this config from that of a training."""

    model: str | None = None
    """Model file to start from; null: the nominal table-tennis model."""

    data: str | None = None
    """Folder of the dataset. `--data` takes its place."""

    out: str = "calibration"
    """Folder that is written. `--out` takes its place."""

    coefficients: Annotated[tuple[str, ...], Field(min_length=1, strict=False)] = (
        "flight.drag.k",
        "contact.restitution.e",
        "contact.table_height.offset",
    )
    """What is calibrated, by parameter name: `flight.` or `contact.`, the effect, its coefficient."""

    split: Literal["random", "label"] = "random"
    """How tracks are parted. random: half to fit, half to judge, by the seed. label: by the label `split` of the
    dataset, `train` to fit and `test` to judge."""

    seed: Annotated[int, Field(ge=0)] = 0
    """Of the random split."""

    observe: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.4
    """Share of a judged track's duration that is observed; the rest is predicted."""

    horizon: Annotated[float, Field(gt=0.0)] | None = None
    """s, how far is predicted; null: to the end of the track."""

    max_iterations: Annotated[int, Field(ge=1)] = 10
    """Most re-linearisations of the tracks about the new mean."""

    tolerance: Annotated[float, Field(gt=0.0)] = 0.05
    """Stop when no coefficient's mean moves by more than this share of its standard error."""

    failure_limit: Annotated[float, Field(ge=0.0, le=1.0)] = 0.2
    """Share of the fitted tracks whose estimate may fail; they are skipped. More stop the run."""

    jobs: Annotated[int, Field(ge=1)] | None = None
    """Processes; null: one per core. The numbers do not depend on it."""
