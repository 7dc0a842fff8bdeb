"""What a training is told; each field with its meaning."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Count = Annotated[int, Field(ge=1)]
Names = Annotated[tuple[str, ...], Field(min_length=1, strict=False)]

Kind = Literal["a-tune", "mlp", "mlp+gs", "skip+gs", "mnn+gs", "lstm", "diffusion"]
NETWORKS = ("mlp", "mlp+gs", "skip+gs", "mnn+gs")
"""Kinds that are a network for the dynamics: those with an architecture."""
SEQUENCES = ("lstm", "diffusion")
"""Kinds that map observations to the rest of a track, without estimator and dynamics."""
AUGMENTED = ("a-tune", "mlp", "lstm", "diffusion")
"""Kinds that turn and shift tracks in training by default. The Gram-Schmidt kinds are invariant by themselves."""


class Section(BaseModel):
    """A part of the config: strict types, nothing unknown, never changed."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)


class ArchitectureConfig(Section):
    """Size and form of a network for the dynamics. null: the kind's default."""

    width_flight: Count | None = None
    """Width of the hidden states in the flight network."""

    width_contact: Count | None = None
    """Width of the hidden states in the contact network."""

    depth: Count | None = None
    """How often the hidden layer is applied."""

    residual: bool | None = None
    """Correct the analytic model `model` instead of taking its place."""

    spin_rate: bool | None = None
    """Let the spin change in flight."""

    pretrain: Annotated[int, Field(ge=0)] = 400
    """Iterations that fit the networks to the analytic model `model`, before they see a track; 0: networks start from a
    ball in vacuum. A residual network starts as the analytic model without any."""


class SplitConfig(Section):
    """Which tracks train and which validate."""

    by: Literal["random", "label", "alternate", "none"] = "random"
    """random: by the seed. label: by the label `split` of the dataset, `train` or `validation`; tracks with another
    value take no part. alternate: every second track validates. none: all train."""

    validation: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.2
    """Share of the tracks that validate in a random split."""


class ObserveConfig(Section):
    """What the estimator sees of a track; the rest is predicted. Exactly one of the two."""

    samples: Count | None = 80
    """Number of observations."""

    seconds: Positive | None = None
    """s, duration of the observed part."""

    @model_validator(mode="before")
    @classmethod
    def _seconds_alone(cls, content: Any) -> Any:
        """Seconds that are given without samples take the place of the default."""
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
    """What is known of the launcher."""

    labels: Names | None = None
    """Labels of the dataset with the launcher's settings, from which the initial spin is learned; null: none."""

    start: Literal["names", "tracks"] = "names"
    """Spins that learning starts from. names: what the settings `topspin` and `sidespin` usually mean, no spin for
    others. tracks: what the analytic model `model` finds in the training tracks."""


class LossConfig(Section):
    """What is minimised: the error of the predicted positions, and how unlikely the observations are."""

    horizon: Positive | None = None
    """s after the observed part, how far is predicted; null: to the end of the track."""

    horizon_start: Positive = 0.3
    """s, horizon of the first epoch, if it grows."""

    horizon_epochs: Annotated[int, Field(ge=0)] = 0
    """Epochs over which the horizon grows to its full length; 0: it is full from the start."""

    likelihood: NotNegative = 0.0
    """Weight of the negative log marginal likelihood of the observed part, from which the noise is learned; 0: the
    noise stays."""

    position_scale: Positive | None = None
    """m, error beyond which the loss of a predicted position grows only linearly; null: squares throughout."""

    anchor: NotNegative = 0.0
    """Weight of the mean square difference from the analytic model `model` on random flights and bounces: what no track
    tells stays as it is there."""

    def horizon_at(self, epoch: int, duration: float) -> float:
        """s, how far is predicted in an epoch (from 0) when `duration` s are left of the track."""
        full = duration if self.horizon is None else min(self.horizon, duration)
        if epoch >= self.horizon_epochs:
            return full
        start = min(self.horizon_start, full)
        return start + (full - start) * epoch / self.horizon_epochs


class NoiseConfig(Section):
    """Initial noise of the estimator. null: the dataset's, or the package's default where it states none."""

    position_scale: Positive | None = None
    """Of an observed position, as a multiple of what its dataset says; null: 1."""

    acceleration: Positive | None = None
    """m/s^2/sqrt(Hz), density of the acceleration that the model lacks."""

    spin: Positive | None = None
    """rad/s/sqrt(s), density of the spin's random walk."""

    contact_velocity: Positive | None = None
    """m/s per axis, of the velocity after a bounce."""

    contact_tangential: NotNegative | None = None
    """m/s, what the two components along the surface have on top."""

    contact_spin: Positive | None = None
    """rad/s per axis, of the spin after a bounce."""

    spin_label: Positive | None = None
    """rad/s per axis, of the initial spin as its label or the launcher tells it."""


class OptimizerConfig(Section):
    """AdamW and how long it runs."""

    learning_rate: Positive = 1e-3
    """Step size of a parameter group of scale 1."""

    schedule: Literal["constant", "cosine"] = "cosine"
    """cosine: the learning rate falls from its full value to zero at the last step."""

    weight_decay: NotNegative = 0.0
    """Decoupled decay per step, in units of the learning rate."""

    clip: Positive | None = 1.0
    """Greatest norm of the gradient of the mean loss of a batch; a longer one is shortened. null: none is."""

    batch: Count = 16
    """Tracks per step, over all processes."""

    epochs: Count = 50
    """How often every training track is seen."""

    warm_start_epochs: Annotated[int, Field(ge=0)] = 0
    """Epochs over which the learning rate rises linearly to its full value."""

    noise_step: Positive = 10.0
    """Scale of the learning rate for the logarithms of learned noise."""

    coefficient_step: Positive = 20.0
    """Scale of the learning rate for declared coefficients, in units of their prior standard deviations: they are as
    different in size as their units. What is as good as known stays."""


def _as_names(data: Any) -> Any:
    """One dataset may be written without a list."""
    return (data,) if isinstance(data, str) else data


class TrainConfig(Section):
    """A whole training. The same config on the same data gives the same numbers.

    Paths are relative to the folder in which the command runs.
    """

    FREE_TO_CHANGE: ClassVar[tuple[str, ...]] = (
        "out",
        "optimizer.epochs",
        "failure_limit",
        "diverged_limit",
        "workers",
        "checkpoint_every",
    )
    """Fields that a resumed run may change."""

    kind: Kind = "mnn+gs"
    """What is trained. a-tune: coefficients of the analytic model. mlp, mlp+gs, skip+gs, mnn+gs: networks for the
    dynamics, on raw or on Gram-Schmidt features. lstm, diffusion: from observations straight to predictions."""

    seed: Annotated[int, Field(ge=0)] = 0
    """Of initial weights, random split, order of the tracks, augmentation."""

    data: Annotated[Names | None, BeforeValidator(_as_names)] = None
    """Folder of the dataset, or a list of several that train one model. `--data` takes its place."""

    out: str = "training"
    """Folder that is written. `--out` takes its place."""

    model: str | None = None
    """Analytic model that a-tune and networks start from and a residual network corrects; null: the nominal
    table-tennis model."""

    architecture: ArchitectureConfig = ArchitectureConfig()
    """Of mlp, mlp+gs, skip+gs, mnn+gs."""

    augment: bool | None = None
    """Turn each training track about z and shift it in x and y, anew in each epoch; null: true for a-tune, mlp, lstm
    and diffusion, false for the Gram-Schmidt kinds."""

    split: SplitConfig = SplitConfig()
    observe: ObserveConfig = ObserveConfig()
    launcher: LauncherConfig = LauncherConfig()
    loss: LossConfig = LossConfig()
    noise: NoiseConfig = NoiseConfig()

    gradient: Literal["implicit", "gauss-newton", "unrolled"] = "implicit"
    """How the loss reaches the parameters through the estimate. implicit: by the implicit function theorem.
    gauss-newton: the same without the residuals' second derivatives. unrolled: through the iterations."""

    optimizer: OptimizerConfig = OptimizerConfig()

    failure_limit: Share = 0.2
    """Share of an epoch's tracks whose estimate may fail; they are left out. More stop the run."""

    diverged_limit: Count = 10
    """Number of steps in a row that may be skipped because loss or gradient is not finite. One more stops the run."""

    workers: Count | None = None
    """Processes on this machine; null: one per core. torchrun's own count takes its place. The numbers depend on it by
    rounding only."""

    checkpoint_every: Count = 1
    """Epochs from one checkpoint to the next."""

    @property
    def augmented(self) -> bool:
        """Whether training tracks are turned and shifted."""
        return self.kind in AUGMENTED if self.augment is None else self.augment

    @model_validator(mode="after")
    def _fields_fit_kind(self) -> Self:
        unused = [] if self.kind in NETWORKS else ["architecture"]
        unused += ["model", "noise", "gradient"] if self.kind in SEQUENCES else []
        for name in unused:
            if getattr(self, name) != type(self).model_fields[name].default:
                raise ValueError(f"'{name}' plays no part in kind '{self.kind}'. Leave it out.")
        return self
