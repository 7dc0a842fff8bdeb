"""Implements `ballfg render`, which films simulated balls over a table, with their true states."""

import re
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ballfg.cli.inputs import EffectsFiles, Seed, know
from ballfg.progress import counted, progress

if TYPE_CHECKING:
    from ballfg.simulation.scene.config import Clock

_cameras, _picture, _balls, _files = (
    partial(typer.Option, rich_help_panel=panel) for panel in ("Cameras", "Picture", "Balls", "Files")
)


def render(
    out: Annotated[Path, _files(help="Folder of the new scene.")],
    seed: Seed = 0,
    shots: Annotated[int, _balls(help="Number of balls, launched one after the other.")] = 6,
    interval: Annotated[float, _balls(help="Time from launch to launch, s; below 1.3 s two balls fly at once.")] = 2.0,
    settings: Annotated[str, _balls(help="Launcher levels, as topspin=-3,sidespin=-5..5,speed=9.")] = "",
    effect: Annotated[
        list[str] | None,
        _balls(help="Undeclared effect on the balls, as wind.x=0.3; may be repeated."),
    ] = None,
    effects_file: EffectsFiles = None,
    rate: Annotated[float, _cameras(help="Frames per second, Hz.")] = 120.0,
    exposure: Annotated[float, _cameras(help="Exposure time, s.")] = 0.002,
    unsynchronised: Annotated[
        bool, _cameras("--unsynchronised", help="Free-running cameras, which expose at different moments.")
    ] = False,
    offset: Annotated[
        list[str] | None, _cameras(help="Undeclared delay of a camera's stamps, s, as left=0.004; may be repeated.")
    ] = None,
    dropout: Annotated[float, _cameras(help="Probability of a dropped frame.")] = 0.0,
    jitter: Annotated[float, _cameras(help="Standard deviation of the stamps' jitter, s.")] = 0.0,
    size: Annotated[str, _cameras(help="Width and height of the images, pixels.")] = "1280x720",
    distance: Annotated[float, _cameras(help="Distance of each camera from the middle of the flights, m.")] = 3.0,
    colour: Annotated[str, _picture(help="Colour of the ball: white or orange.")] = "white",
    noise: Annotated[float, _picture(help="Standard deviation of a dark pixel, grey levels.")] = 2.0,
    flicker: Annotated[float, _picture(help="Relative amplitude of the lamps' flicker at 100 Hz.")] = 0.03,
    distractors: Annotated[bool, _picture(help="Moving people and reflections beside the ball.")] = True,
    images: Annotated[bool, _files("--images", help="PNG images in place of videos, without loss.")] = False,
    force: Annotated[bool, _files("--force", help="Replace a rendered scene.")] = False,
) -> None:
    """Film simulated balls with three cameras over a table, and write the truth beside the videos.

    Example: ballfg render --out scene --shots 6 --rate 120 --exposure 0.002 --unsynchronised

    cameras.yaml holds the cameras, NAME_stamps.csv the stamps of the frames, truth.csv the true states over time,
    visible.csv the true place of each ball in each frame, scene.yaml all settings.
    """
    from ballfg.simulation import SceneConfig, parse_effects, record, table_rig, write_scene
    from ballfg.simulation.scene.recording import check_scene_folder
    from ballfg.simulation.settings import parse_settings

    know(effects_file)
    check_scene_folder(out, force=force)
    parts = re.fullmatch(r"\s*([+-]?\d+)\s*x\s*([+-]?\d+)\s*", size)
    if parts is None:
        raise ValueError(f"--size must read WIDTHxHEIGHT; got {size!r}. Write 1280x720.")
    cameras = table_rig((int(parts[1]), int(parts[2])), distance)
    names = [camera.name for camera in cameras]
    look: dict[str, Any] = {"colour": colour, "noise": noise, "flicker": flicker, "distractors": distractors}
    config = SceneConfig(
        shots=shots,
        interval=interval,
        seed=seed,
        settings=parse_settings(settings) if settings else {},
        undeclared=parse_effects(effect or ()),
        rate=rate,
        exposure=exposure,
        clocks=_clocks(names, rate, seed, offset or (), unsynchronised=unsynchronised),
        dropout=dropout,
        jitter=jitter,
        **look,
    )
    recording = record(config, cameras)
    write_scene(out, recording, images=images, force=force, watch=progress)
    kind = "images" if images else "a video"
    count = recording.image_count
    typer.echo(
        f"wrote {counted(count, 'frame')} to {out}: {kind} and stamps for each of {', '.join(names)}; cameras.yaml"
    )
    typer.echo(f"wrote the truth to {out}: truth.csv, visible.csv, scene.yaml")


def _clocks(
    names: list[str], rate: float, seed: int, offsets: tuple[str, ...] | list[str], *, unsynchronised: bool
) -> "dict[str, Clock]":
    from dataclasses import replace

    from ballfg.simulation.scene.config import Clock
    from ballfg.simulation.scene.shutter import free_running

    clocks = {name: Clock() for name in names}
    if unsynchronised:
        clocks = free_running(names, rate, seed)
    for text in offsets:
        name, _, seconds = text.partition("=")
        if name not in clocks:
            raise ValueError(f"--offset must name a camera, {', '.join(names)}; got {text!r}. Write left=0.004.")
        try:
            late = float(seconds)
        except ValueError:
            raise ValueError(f"--offset must read CAMERA=SECONDS; got {text!r}. Write left=0.004.") from None
        clocks[name] = replace(clocks[name], offset=late)
    return clocks
