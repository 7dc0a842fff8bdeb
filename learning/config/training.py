"""Defines the config of a training; each field has its meaning below it."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from ballfg.checks import shown
from ballfg.dynamics.coefficient import warn_of
from ballfg.dynamics.networks.architecture import MOST_DEPTH, MOST_WIDTH
from ballfg.learning.trainee import TRAINEES
from ballfg.machine import MOST_JOBS

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Count = Annotated[int, Field(ge=1)]
Width = Annotated[int, Field(ge=1, le=MOST_WIDTH)]
Jobs = Annotated[int, Field(ge=1, le=MOST_JOBS)]
Names = Annotated[tuple[str, ...], Field(min_length=1, strict=False)]


class Section(BaseModel):
    """A part of a config: strict types, no unknown keys, immutable."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)

    EARLIER: ClassVar[Mapping[str, str]] = {}
    """Earlier names of fields, which files may still use, and the names of today."""

    @model_validator(mode="before")
    @classmethod
    def _renamed(cls, content: Any) -> Any:
        return cls.renamed(content) if isinstance(content, dict) else content

    @classmethod
    def renamed(cls, content: Mapping[str, Any]) -> dict[str, Any]:
        """The content under the names of today; an earlier name brings a `DeprecationWarning`.

        Raises: ValueError: if it has a field under both names.
        """
        for earlier, name in cls.EARLIER.items():
            if earlier in content and name in content:
                raise ValueError(f"'{earlier}' is the earlier name of '{name}'; got both. Delete '{earlier}'.")
            if earlier in content:
                warn_of(earlier, name)
        return {cls.EARLIER.get(key, key): value for key, value in content.items()}


class ArchitectureConfig(Section):
    """Size and form of a network for the dynamics. null: the default of the kind."""

    width_flight: Width | None = None
    """Width of the hidden states in the flight network."""

    width_contact: Width | None = None
    """Width of the hidden states in the contact network."""

    depth: Annotated[int, Field(ge=1, le=MOST_DEPTH)] | None = None
    """Number of times that the hidden layer is applied."""

    residual: bool | None = None
    """Whether the network corrects the analytic model `model` instead of replacing it."""

    spin_rate: bool | None = None
    """Whether the spin changes in flight."""

    pretrain: Annotated[int, Field(ge=0)] = 400
    """Iterations that fit the networks to the analytic model `model` before the training; 0: networks start from a ball
    in vacuum. A residual network starts as the analytic model and needs none."""


class SplitConfig(Section):
    """Which tracks train and which validate."""

    by: Literal["random", "label", "alternate", "none"] = "random"
    """random: by the seed. label: by the label `split` of the dataset, `train` or `validation`; tracks with another
    value are not used. alternate: every second track validates. none: all train."""

    validation: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.2
    """Share of the tracks that validate in a random split."""


class ObserveConfig(Section):
    """The observed part of a track; the rest is predicted. Exactly one of the two; a number alone is seconds."""

    samples: Count | None = 80
    """Number of observed samples."""

    seconds: Positive | None = None
    """s, duration of the observed part."""

    @model_validator(mode="before")
    @classmethod
    def _seconds_alone(cls, content: Any) -> Any:
        """Seconds, in the section or as a number in its place, replace the default number of samples."""
        if isinstance(content, int | float) and not isinstance(content, bool):
            return {"samples": None, "seconds": content}
        if not isinstance(content, dict | cls):
            raise ValueError(
                f"must be seconds, or a section with samples or seconds; got {shown(content)}. Write 0.25."
            )
        if isinstance(content, dict) and content.get("seconds") is not None and "samples" not in content:
            return content | {"samples": None}
        return content

    @model_validator(mode="after")
    def _one(self) -> Self:
        if (self.samples is None) == (self.seconds is None):
            got = f"samples {self.samples} and seconds {self.seconds}"
            raise ValueError(f"must have exactly one of samples and seconds; got {got}. Set the other to null.")
        return self


class LauncherConfig(Section):
    """The launcher's settings."""

    labels: Names | None = None
    """Labels of the dataset that hold the launcher's settings. The spin that they mean is learned; null: none."""

    start: Literal["names", "tracks"] = "names"
    """Spins that learning starts from. names: the usual meaning of the settings `topspin` and `sidespin`, no spin for
    others. tracks: the spins that the analytic model `model` finds in the training tracks."""


class LossConfig(Section):
    """The loss: the error of the predicted positions, and the likelihood of the observations."""

    horizon: Positive | None = None
    """s after the observed part that are predicted; null: to the end of the track."""

    horizon_start: Positive = 0.3
    """s, horizon of the first epoch where the horizon grows."""

    horizon_epochs: Annotated[int, Field(ge=0)] = 0
    """Epochs over which the horizon grows to its full length; 0: full from the start."""

    likelihood: NotNegative = 0.0
    """Weight of the negative log marginal likelihood of the observed part, from which the noise is learned; 0: the
    noise is not learned."""

    position_scale: Positive | None = None
    """m, error beyond which the loss of a predicted position grows linearly; null: squared errors throughout."""

    anchor: NotNegative = 0.0
    """Weight of the mean square difference from the analytic model `model` on random flights and bounces. It keeps the
    model close to the analytic one where there are no data."""

    def horizon_at(self, epoch: int, duration: float) -> float:
        """The horizon, s, of an epoch (from 0) when `duration` s of the track are left."""
        full = duration if self.horizon is None else min(self.horizon, duration)
        if epoch >= self.horizon_epochs:
            return full
        start = min(self.horizon_start, full)
        return start + (full - start) * epoch / self.horizon_epochs


class NoiseConfig(Section):
    """Initial noise of the estimator. null: the dataset's, or the default of the package where it states none."""

    position_scale: Positive | None = None
    """Noise of an observed position as a multiple of that in its dataset; null: 1."""

    acceleration: Positive | None = None
    """m/s^2/sqrt(Hz), density of unmodelled acceleration."""

    spin: Positive | None = None
    """rad/s/sqrt(s), density of the spin's random walk."""

    contact_velocity: Positive | None = None
    """m/s per axis, noise of the velocity after a bounce."""

    contact_tangential: NotNegative | None = None
    """m/s, additional noise of the two components along the surface."""

    contact_spin: Positive | None = None
    """rad/s per axis, noise of the spin after a bounce."""

    spin_label: Positive | None = None
    """rad/s per axis, noise of the initial spin as given by a label or the launcher."""


class OptimizerConfig(Section):
    """AdamW and its duration."""

    learning_rate: Positive = 1e-3
    """Step size of a parameter group of scale 1."""

    schedule: Literal["constant", "cosine"] = "cosine"
    """cosine: the learning rate falls from its full value to zero at the last step."""

    weight_decay: NotNegative = 0.0
    """Decoupled weight decay per step, in units of the learning rate."""

    clip: Positive | None = 1.0
    """Largest norm of the gradient of a batch's mean loss; longer ones are scaled down. null: no limit."""

    batch: Count = 16
    """Tracks per step, over all processes."""

    epochs: Count = 50
    """Passes over the training tracks."""

    warm_start_epochs: Annotated[int, Field(ge=0)] = 0
    """Epochs over which the learning rate rises linearly to its full value."""

    noise_step: Positive = 10.0
    """Scale of the learning rate for the logarithms of learned noise."""

    coefficient_step: Positive = 20.0
    """Scale of the learning rate for declared coefficients, in units of their prior standard deviations. Coefficients
    with a prior standard deviation of zero are kept fixed."""


def _known(kind: Any) -> Any:
    """The kind itself. Raises: ValueError: if no trainee of that name is registered."""
    if isinstance(kind, str) and kind in TRAINEES:
        return kind
    *names, last = (f"'{name}'" for name in TRAINEES)
    listed = f"{', '.join(names)} or {last}"
    raise ValueError(f"must be {listed}; got {shown(kind)}. To calibrate coefficients write 'kind: calibrate'.")


class TrainConfig(Section):
    """A training. The same config on the same data gives the same numbers.

    Paths are relative to the folder in which the command runs.
    """

    FREE_TO_CHANGE: ClassVar[tuple[str, ...]] = (
        "out",
        "optimizer.epochs",
        "failure_limit",
        "diverged_limit",
        "jobs",
        "checkpoint_every",
    )
    """Fields that a resumed run may change."""

    EARLIER: ClassVar[Mapping[str, str]] = {"workers": "jobs"}

    kind: Annotated[str, BeforeValidator(_known)] = "mnn+gs"
    """What is trained. a-tune: coefficients of the analytic model. mlp, mlp+gs, skip+gs, mnn+gs: networks for the
    dynamics, on raw or on Gram-Schmidt features. lstm, diffusion: networks from observations to predictions. Other
    names: kinds that are registered with `register_trainee`."""

    seed: Annotated[int, Field(ge=0)] = 0
    """Seed of initial weights, random split, order of the tracks and augmentation."""

    data: Annotated[Names | None, BeforeValidator(lambda data: (data,) if isinstance(data, str) else data)] = None
    """Folder of the dataset, or a list of several that train one model. `--data` replaces it."""

    out: str = "training"
    """Folder that is written. `--out` replaces it."""

    model: str | None = None
    """Analytic model that a-tune and networks start from and a residual network corrects; null: the nominal model of
    the dataset's ball."""

    architecture: ArchitectureConfig = ArchitectureConfig()
    """Network of mlp, mlp+gs, skip+gs, mnn+gs."""

    augment: bool | None = None
    """Whether each training track is rotated about z and shifted in x and y, differently in each epoch; null: true for
    a-tune, mlp, lstm and diffusion, false for the Gram-Schmidt kinds."""

    options: dict[str, Any] = {}
    """Settings of a registered kind, which reads them itself."""

    split: SplitConfig = SplitConfig()
    observe: ObserveConfig = ObserveConfig()
    launcher: LauncherConfig = LauncherConfig()
    loss: LossConfig = LossConfig()
    noise: NoiseConfig = NoiseConfig()

    gradient: Literal["implicit", "gauss-newton", "unrolled"] = "implicit"
    """Method of the gradient through the estimate. implicit: by the implicit function theorem. gauss-newton: the same
    without the residuals' second derivatives. unrolled: through the solver's iterations."""

    optimizer: OptimizerConfig = OptimizerConfig()

    failure_limit: Share = 0.2
    """Share of an epoch's tracks whose estimates may fail and are left out. More stop the run."""

    diverged_limit: Count = 10
    """Steps in a row that may be skipped because loss or gradient is not finite. One more stops the run."""

    jobs: Jobs | None = None
    """Processes on this machine; null: one per core. The count of torchrun replaces it. The results depend on it by
    rounding only."""

    checkpoint_every: Count = 1
    """Epochs between checkpoints."""

    @property
    def augmented(self) -> bool:
        """True if training tracks are rotated and shifted."""
        return TRAINEES[self.kind].augmented if self.augment is None else self.augment

    @model_validator(mode="after")
    def _fields_fit_kind(self) -> Self:
        for name in TRAINEES[self.kind].unused:
            given, default = self, TrainConfig.model_construct()
            for part in name.split("."):
                given, default = getattr(given, part), getattr(default, part)
            if given != default:
                raise ValueError(f"'{name}' plays no part in kind '{self.kind}'. Leave it out.")
        return self
