"""`ballfg example`: shots to try everything with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from ballfg.cli.inputs import Seed
from ballfg.progress import progress

PLAIN, WINDY = "shots", "windy"
WIND = "wind.x=0.5"
MEASURED = (
    ("aimy", "88 shots of a launcher with three wheels", "intelligent-soft-robots/ball_prediction", "BSD-3-Clause"),
    ("ballgun", "52 shots of a ball gun", "intelligent-soft-robots/pam_configuration", "BSD-3-Clause"),
    ("robot_rallies", "50 rallies of a robot", "intelligent-soft-robots/pam_configuration", "BSD-3-Clause"),
    ("spindoe", "shots with measured spin", "cogsys-tuebingen/spindoe", "none stated: for evaluation only"),
)
"""Name, what it is, the repository on GitHub that publishes it, its licence."""


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
    from ballfg.files.whole_folder import check_folder, check_replaceable
    from ballfg.simulation.writing import TRUTH_FILE

    plain = simulation.SimulationConfig(tracks=tracks, seed=seed)
    windy = replace(plain, seed=seed + 1, undeclared=simulation.parse_effects([WIND]))
    named = ((PLAIN, plain), (WINDY, windy))
    if out.exists():
        for name, _ in named:
            check_replaceable(out / name, mark=TRUTH_FILE, what="a simulated dataset", force=force)
    check_folder(out)
    out.mkdir(exist_ok=True)
    for name, config in named:
        simulation.write_simulation(out / name, config, force=force, watch=progress)
    print(f"{out / PLAIN}: {tracks} simulated table-tennis shots with bounces, truth.csv beside them")
    print(f"{out / WINDY}: {tracks} more, with an effect that their model.yaml does not declare")
    print("\nnext:")
    print(f"  ballfg estimate {out / PLAIN} --out states.csv")
    print(f"  ballfg diagnose {out / WINDY} --out diagnosis")
    print("\nmeasured sets, to be had from their authors (ballfg import reads their files):")
    for name, what, source, licence in MEASURED:
        print(f"  {name}: {what}; https://github.com/{source}; licence {licence}")
