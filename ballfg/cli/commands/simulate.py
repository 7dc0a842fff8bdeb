"""Implements `ballfg simulate`, which writes synthetic tracks, with or without undeclared effects."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from ballfg.cli.inputs import EffectsFiles, Seed, know
from ballfg.progress import counted, progress

if TYPE_CHECKING:
    from ballfg.simulation.balls import BallKind

_noise, _ball_option, _files = (
    partial(typer.Option, rich_help_panel=panel) for panel in ("Noise", "Ball and launcher", "Files")
)


def simulate(
    out: Annotated[Path, _files(help="Folder of the new dataset.")],
    tracks: Annotated[int, typer.Option(help="Number of tracks.")] = 717,
    seed: Seed = 0,
    rate: Annotated[float, typer.Option(help="Frames per second, Hz.")] = 100.0,
    noise: Annotated[float, _noise(help="Standard deviation of each measured coordinate, m.")] = 0.003,
    dropout: Annotated[float, _noise(help="Probability of a dropped frame.")] = 0.0,
    jitter: Annotated[float, _noise(help="Standard deviation of the stamps' jitter, s.")] = 0.0,
    outliers: Annotated[float, _noise(help="Probability of an outlier.")] = 0.0,
    outlier_size: Annotated[float, _noise(help="Typical distance of an outlier, m.")] = 0.1,
    spin_noise: Annotated[float, _noise(help="Standard deviation of each component of the spin labels, rad/s.")] = 4.0,
    spin_labels: Annotated[bool, _noise(help="Spin labels in labels.csv; launcher settings are always there.")] = True,
    memory: Annotated[float, _noise(help="Standard deviation of an error that lasts from frame to frame, m.")] = 0.0,
    memory_time: Annotated[float, _noise(help="Time over which that error lasts, s.")] = 0.015,
    process_noise: Annotated[float, _noise(help="Density of a white acceleration in flight, m/s^1.5.")] = 0.0,
    spin_process_noise: Annotated[float, _noise(help="Density of a white angular acceleration, rad/s^1.5.")] = 0.0,
    contact_noise: Annotated[float, _noise(help="Random kick to the velocity after each bounce, m/s.")] = 0.0,
    contact_spin_noise: Annotated[float, _noise(help="Random kick to the spin after each bounce, rad/s.")] = 0.0,
    ball: Annotated[
        str, _ball_option(help="Known ball, by its name in ballfg balls, or a ball file (YAML).")
    ] = "table-tennis",
    model: Annotated[Path | None, _ball_option(help="Model file that replaces the ball's own model.")] = None,
    settings: Annotated[str, _ball_option(help="Launcher levels, as topspin=-3,sidespin=-5..5,speed=9.")] = "",
    effect: Annotated[
        list[str] | None,
        _ball_option(help="Undeclared effect, in no dataset or model file, as wind.x=0.3; may be repeated."),
    ] = None,
    effects_file: EffectsFiles = None,
    format: Annotated[str, _files(help="Format of the tables: csv or parquet.")] = "csv",
    force: Annotated[bool, _files("--force", help="Replace a simulated dataset.")] = False,
) -> None:
    """Simulate a ball launcher and write its tracks as a dataset, with the truth beside them.

    Example: ballfg simulate --out windy --tracks 50 --noise 0.003 --effect wind.x=0.3

    The dataset holds the measurements, model.yaml the declared model, for the option --model of other commands.
    truth.yaml holds the undeclared effects and all settings, truth.csv the true state at every stamp.
    """
    from ballfg import simulation
    from ballfg.simulation.settings import parse_settings
    from ballfg.simulation.writing import FileFormat

    know(effects_file)
    config = simulation.SimulationConfig(
        tracks=tracks,
        rate=rate,
        seed=seed,
        ball=_ball(ball, model),
        settings=parse_settings(settings) if settings else {},
        noise=simulation.MeasurementNoise(
            noise, dropout, jitter, outliers, outlier_size, spin_noise, memory, memory_time
        ),
        process=simulation.MotionNoise(process_noise, spin_process_noise, contact_noise, contact_spin_noise),
        undeclared=simulation.parse_effects(effect or ()),
        spin_labels=spin_labels,
    )
    simulation.write_simulation(out, config, cast(FileFormat, format), force=force, watch=progress)
    names = ", ".join(e.name for e in config.undeclared) or "none"
    files = f"tracks.{format}, labels.csv, dataset.yaml, model.yaml (declared)"
    typer.echo(f"wrote {counted(tracks, 'track')} to {out}: {files}")
    typer.echo(f"wrote the truth to {out}: truth.{format}, truth.yaml (undeclared effects: {names})")


def _ball(name: str, model: Path | None) -> "BallKind":
    from ballfg.dynamics import AnalyticModel, load_model
    from ballfg.simulation.balls import ball_kind, with_model

    kind = ball_kind(name)
    if model is None:
        return kind
    loaded = load_model(model, radius=kind.ball.radius, inertia_factor=kind.model.inertia_factor)
    if not isinstance(loaded, AnalyticModel):
        raise ValueError(f"--model must be analytic to simulate with; {model} has a learned part. Give another one.")
    return with_model(kind, loaded)
