"""Implements `ballfg example`, which writes shots for trying everything."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ballfg.cli.inputs import Seed
from ballfg.progress import progress

if TYPE_CHECKING:
    from ballfg.simulation import SimulationConfig

PLAIN, WINDY, CAPTURE = "shots", "windy", "capture.csv"
WIND = "wind.x=0.5"
MEASURED = (
    ("aimy", "88 shots of a launcher with three wheels", "intelligent-soft-robots/ball_prediction", "BSD-3-Clause"),
    ("ballgun", "52 shots of a ball gun", "intelligent-soft-robots/pam_configuration", "BSD-3-Clause"),
    ("robot_rallies", "50 rallies of a robot", "intelligent-soft-robots/pam_configuration", "BSD-3-Clause"),
    ("spindoe", "shots with measured spin", "cogsys-tuebingen/spindoe", "none stated: for evaluation only"),
)
"""Name, description, publishing repository on GitHub, licence."""
PAUSE = 1.5  # s between two shots of the recording


def example(
    out: Annotated[Path, typer.Option(help="New folder for both datasets.")] = Path("example"),
    tracks: Annotated[int, typer.Option(min=6, help="Shots of each dataset.")] = 60,
    seed: Seed = 0,
    force: Annotated[bool, typer.Option("--force", help="Replace earlier examples.")] = False,
) -> None:
    """Write simulated shots to try everything with, and others in which the air moves and nobody says so.

    The measured sets of the documentation are not part of the package; where they come from is printed.

    Example: ballfg example --out example
    """
    from ballfg import simulation
    from ballfg.files.whole_folder import check_replaceable, whole_folder
    from ballfg.simulation.writing import SIMULATION_FILES
    from ballfg.tracks.writing import TRUTH_FILE

    plain = simulation.SimulationConfig(tracks=tracks, seed=seed)
    windy = replace(plain, seed=seed + 1, undeclared=simulation.parse_effects([WIND]))
    named = ((PLAIN, plain), (WINDY, windy))
    earlier = [f"{name}/{file}" for name, _ in named for file in SIMULATION_FILES]
    with whole_folder(out, earlier=earlier) as stage:
        if out.exists():
            for name, _ in named:
                check_replaceable(out / name, mark=TRUTH_FILE, what="a simulated dataset", force=force)
        for name, config in named:
            simulation.write_simulation(stage / name, config, watch=progress)
        capture = _capture(replace(plain, tracks=min(tracks, 12), seed=seed + 2))
        (stage / CAPTURE).write_text(capture, encoding="utf-8")
    print(f"{out / PLAIN}: {tracks} simulated table-tennis shots with bounces, truth.csv beside them")
    print(f"{out / WINDY}: {tracks} more, with an effect that their model.yaml does not declare")
    print(f"{out / CAPTURE}: a recording as another program writes it: one file, mm and ms, y up, decimal commas")
    print("\nnext:")
    print(f"  ballfg estimate {out / PLAIN} --out states.csv")
    print(f"  ballfg import {out / CAPTURE} --out mine")
    print(f"  ballfg diagnose {out / WINDY} --out diagnosis")
    print("\nmeasured sets, to be had from their authors (ballfg import reads their files):")
    for name, what, source, licence in MEASURED:
        print(f"  {name}: {what}; https://github.com/{source}; licence {licence}")


def _capture(config: "SimulationConfig") -> str:
    """Shots one after another in one table, in a foreign program's units and axes."""
    from ballfg.simulation import simulate

    lines, begin = ["Zeit [ms];X [mm];Y [mm];Z [mm]"], 0.0
    for shot in simulate(config):
        times, (x, y, z) = begin + shot.track.times, shot.track.positions.T
        for row in zip(times, x, z, -y, strict=True):
            lines.append(";".join(f"{1e3 * number:.3f}".replace(".", ",") for number in row))
        begin = float(times[-1]) + PAUSE
    return "\n".join(lines) + "\n"
