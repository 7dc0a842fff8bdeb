"""Defines the config of a calibration; each field has its meaning below it."""

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from ballfg.checks import shown
from ballfg.dynamics.coefficient import todays_names
from ballfg.learning.config.training import Count, Jobs, Names, Positive, Section, Share

Coefficients = Annotated[
    tuple[str, ...],
    Field(min_length=1, strict=False),
    AfterValidator(todays_names),
]


def _folders(data: object) -> object:
    """One folder as text, several as a tuple. Raises: ValueError: anything else."""
    if data is None or isinstance(data, str):
        return data
    if not isinstance(data, list | tuple) or not data or not all(isinstance(one, str) for one in data):
        raise ValueError(f"must be a folder, or a list of folders; got {shown(data)}.")
    return data[0] if len(data) == 1 else tuple(data)


class CalibrationConfig(Section):
    """A calibration. The same config on the same data gives the same numbers.

    Paths are relative to the folder in which the command runs.
    """

    FREE_TO_CHANGE: ClassVar[tuple[str, ...]] = ("out", "data", "model", "max_iterations", "tolerance", "jobs")
    """Fields that a resumed run may change: without effect on the result, or compared by content (data, model)."""

    EARLIER: ClassVar[Mapping[str, str]] = {"observe": "observed_share"}

    kind: Literal["calibrate", "auto"] = "calibrate"
    """calibrate: the model that this config describes. auto: the model that predicts best of nominal, calibrated, with
    groups, and with a correction; `groups` is `group` if it is null."""

    model: str | None = None
    """Model file to start from; null: the nominal model of the dataset's ball."""

    data: Annotated[str | Names | None, BeforeValidator(_folders)] = None
    """Folder of the dataset, or a list of several for `kind: calibrate`: each is calibrated by itself, and what they
    have in common is a model for rooms and balls that none of them shows. `--data` replaces it."""

    out: str = "calibration"
    """Folder that is written. `--out` replaces it."""

    source: Literal["positions", "detections"] | None = None
    """positions: of the dataset's table of tracks. detections: the sightings of its cameras, one or more. null:
    positions where there is a table of them."""

    anyway: bool = False
    """Also if less than half of the samples fall like a ball: the flights are used."""

    coefficients: Coefficients | None = None
    """Calibrated parameters by name: `flight.` or `bounce.`, the effect, its coefficient. null: drag, restitution and
    table height, as far as the model has them; from one camera drag alone."""

    groups: str | None = None
    """Label that names a track's launcher, player, ball or session, such as `group`: the spins of each group get a
    mean and a spread, which the model file keeps. A dataset without labels is one group. null: no groups."""

    correction: bool = False
    """Learn a correction of drag and lift over speed and spin ratio too, shared by all tracks; needs groups."""

    split: Literal["random", "label"] = "random"
    """random: half of the tracks are fitted and half judge, by the seed. label: by the label `split` of the dataset,
    `train` to fit and `test` to judge."""

    seed: Annotated[int, Field(ge=0)] = 0
    """Seed of the random split."""

    observed_share: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.4
    """Share of a judged track's duration that is observed; the rest is predicted."""

    horizon: Positive | None = None
    """s that are predicted; null: to the end of the track."""

    max_iterations: Count = 10
    """Maximum number of iterations; each linearises the tracks about the last mean."""

    tolerance: Positive = 0.05
    """The run ends when no mean moves by more than this share of its standard error."""

    failure_limit: Share = 0.2
    """Share of the fitted tracks whose estimates may fail and are skipped. More stop the run."""

    jobs: Jobs | None = None
    """Processes; null: one per core. The result does not depend on it."""

    @model_validator(mode="after")
    def _check_correction(self) -> Self:
        if isinstance(self.data, tuple) and (self.correction or self.kind == "auto"):
            raise ValueError(
                "kind: auto and a correction belong to one room and ball; got several datasets. Give one, or write "
                "kind: calibrate without a correction."
            )
        if self.correction and (self.kind == "auto" or self.groups is None):
            raise ValueError(
                "correction must come with groups, whose spins it needs, and kind: auto decides on it; got neither. "
                "Write 'groups: group' for one group of all tracks, or leave correction out."
            )
        return self
