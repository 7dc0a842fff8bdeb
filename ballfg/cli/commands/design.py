"""Implements `ballfg design`, which chooses the next shots, or the place of a camera."""

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from ballfg.cli import inputs
from ballfg.progress import counted, print_notes

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from ballfg.diagnosis.design.plan import ShotPlan
    from ballfg.dynamics import AnalyticModel
    from ballfg.tracks import Dataset

SHOWN: Final = 20  # Places that are printed
SHOTS: Final = 10  # Chosen by default


def design(
    dataset: inputs.DatasetFolder,
    candidates: Annotated[
        str | None,
        typer.Option(help="Launcher settings to choose from, as topspin=-3..5,speed=8..14 or wheel=900..1500:100."),
    ] = None,
    stand: Annotated[
        str | None, typer.Option(help="Places (m) of one camera to choose from, as x=-4..4:2,y=-5..-3,z=1..3.")
    ] = None,
    cameras: Annotated[
        Path | None, typer.Option(help="With --stand: file of the camera, whose lens counts, not its place.")
    ] = None,
    noise: Annotated[
        float | None,
        typer.Option(help="With --stand: noise of the ball's place in the picture, px.", show_default="0.5"),
    ] = None,
    model: inputs.ModelFile = None,
    between: Annotated[
        str | None, typer.Option(help="Two effects to tell apart, as frame_tilt,table_tilt or wind.x,drag.k.")
    ] = None,
    shrink: Annotated[str | None, typer.Option(help="Coefficient whose error bar is to shrink, as drag.k.")] = None,
    diagnosis: Annotated[
        Path | None,
        typer.Option(help="Folder of a diagnosis: tell apart what it could not.", show_default="diagnose now"),
    ] = None,
    shots: Annotated[int | None, typer.Option(help="Number of shots to choose.", show_default="10")] = None,
    out: Annotated[Path | None, typer.Option(help="Table of the shots, .csv or .parquet.")] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Random seed, of the random shots to compare with.", show_default="0")
    ] = None,
    effects_file: inputs.EffectsFiles = None,
    observations_file: inputs.ObservationsFiles = None,
    jobs: inputs.Jobs = inputs.CORES,
) -> None:
    """Choose the launcher's next shots, those that best tell two effects apart; or where one camera should stand.

    The settings are columns of the dataset's labels.csv, whose tracks teach what they do. Printed are the
    shots in order, the standard deviations to expect after each, and what as many random shots would bring.

    Example: ballfg design shots --candidates topspin=-3..5,sidespin=-5..5,speed=8..14 --between wind.x,drag.k

    Example: ballfg design shots --stand x=-4..4:2,y=-5..-3,z=1..3 --cameras lens.yaml
    """
    if stand is not None or candidates is None:
        shots_only = {"candidates": candidates, "between": between, "shrink": shrink, "diagnosis": diagnosis}
        inputs.know(observations=observations_file)
        _stand(dataset, stand, cameras, noise, model, effects_file, out, jobs, shots=shots, seed=seed, **shots_only)
        return
    for name, value in (("cameras", cameras), ("noise", noise)):
        if value is not None:
            raise ValueError(f"--{name} is for --stand. Leave it out.")
    from ballfg.diagnosis.design.choice import parse_levels
    from ballfg.diagnosis.design.plan import check_labels, design_shots
    from ballfg.dynamics import AnalyticModel
    from ballfg.tracks import TableWriter

    levels = parse_levels(candidates)
    inputs.know(observations=observations_file)
    if out is not None:
        TableWriter(out, name="out")  # refuses a path that cannot be written
        inputs.check_out(out, dataset)
    opened = inputs.open_inputs(dataset, model, effects_file).changing()
    if not isinstance(opened.model, AnalyticModel):
        raise ValueError(f"--model must be analytic: effects are added to it; {model} is a learned one. Give another.")
    check_labels(opened.dataset, tuple(levels))
    plan = design_shots(
        opened.dataset,
        opened.model,
        levels,
        between=_pairs(between, shrink, diagnosis, opened.dataset, opened.model, jobs),
        shrink=shrink or "",
        shots=SHOTS if shots is None else shots,
        seed=seed or 0,
        jobs=jobs,
        watch=_say,
    )
    print(*_lines(plan), sep="\n")
    print_notes(plan.remarks)
    if out is not None:
        columns: Mapping[str, ArrayLike] = {
            "shot": list(range(1, len(plan.settings) + 1)),
            **dict(zip(plan.setting_names, plan.settings.T, strict=True)),
            **{f"sigma_{name}": column for name, column in zip(plan.names, plan.sigmas[1:].T, strict=True)},
            "error": plan.error[1:],
            "error_random": plan.random[1:],
        }
        with TableWriter(out, name="out") as table:
            table.write(columns)
        print(f"{out}: {counted(len(plan.settings), 'shot')}")


def _stand(
    dataset: Path,
    stand: str | None,
    cameras: Path | None,
    noise: float | None,
    model: Path | None,
    effects_file: list[Path] | None,
    out: Path | None,
    jobs: int,
    **shots_only: object,
) -> None:
    """Prints how well a camera would know the strokes of a dataset from each place. Raises: ValueError: options."""
    from ballfg.checks import check_number
    from ballfg.diagnosis.design.choice import combinations, parse_levels
    from ballfg.diagnosis.design.stand import NOISE, where_to_stand
    from ballfg.tracks import TableWriter
    from ballfg.vision.camera_file import read_cameras

    noise = NOISE if noise is None else check_number("--noise", noise, "px")
    if stand is None:
        raise ValueError("--candidates or --stand must be given; got neither. Say what to choose from.")
    for name, value in shots_only.items():
        if value is not None:
            raise ValueError(f"--{name} is for shots, --stand for a camera. Leave one of them out.")
    levels = parse_levels(stand, "--stand")
    if sorted(levels) != ["x", "y", "z"]:
        raise ValueError(f"--stand must name x, y and z; got {', '.join(levels)}. Write x=-4..4:2,y=-5..-3,z=1..3.")
    if cameras is None:
        raise ValueError("--stand needs --cameras, a file with the lens of the camera. Give one.")
    (lens, *others) = read_cameras(cameras, posed=False)
    if others:
        raise ValueError(f"{cameras} must hold one camera for --stand; it holds {1 + len(others)}. Give one.")
    if out is not None:
        TableWriter(out, name="out")  # refuses a path that cannot be written
        inputs.check_out(out, dataset)
    opened = inputs.open_inputs(dataset, model, effects_file).changing()
    places = combinations({axis: levels[axis] for axis in "xyz"})
    found = where_to_stand(opened.dataset, opened.model, lens, places, noise=noise, jobs=jobs)
    print(f"{lens.name} at {len(found)} places, best first: median error; samples seen; strokes uncertain in depth")
    for one in found[:SHOWN]:
        place = " ".join(f"{axis}={value:<6g}" for axis, value in zip("xyz", one.place, strict=True))
        error = f"{1e3 * one.sigma:6.0f} mm" if math.isfinite(one.sigma) else "not seen"
        print(f"{place} {error:>9}  {100 * one.seen:3.0f} %  {100 * one.uncertain:3.0f} %")
    if out is not None:
        columns = {axis: [one.place[i] for one in found] for i, axis in enumerate("xyz")}
        columns |= {name: [getattr(one, name) for one in found] for name in ("sigma", "seen", "uncertain")}
        with TableWriter(out, name="out") as table:
            table.write(columns)
        print(f"{out}: {len(found)} places")


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _pairs(
    between: str | None, shrink: str | None, folder: Path | None, data: "Dataset", model: "AnalyticModel", jobs: int
) -> Sequence[tuple[str, str]]:
    """The pairs of effects to separate: from the options, else those that a diagnosis left open; none with --shrink."""
    from ballfg.diagnosis import diagnose
    from ballfg.diagnosis.design.goal import pairs_of, reported_pairs

    given = [name for name, value in (("--between", between), ("--shrink", shrink), ("--diagnosis", folder)) if value]
    if len(given) > 1:
        raise ValueError(f"{' and '.join(given)} exclude each other. Give one of them.")
    if shrink:
        return ()
    if between:
        one, _, other = (text.strip() for text in between.partition(","))
        if not one or not other or "," in other:
            raise ValueError(f"--between must be two effects, separated by a comma; got '{between}'. Name two.")
        return [(one, other)]
    if folder is not None:
        return reported_pairs(folder)
    _say("nothing says what the shots are for: diagnosing the dataset")
    return pairs_of(diagnose(data, model, jobs=jobs, watch=_say))


def _lines(plan: "ShotPlan") -> Iterator[str]:
    sides = [" ".join(side) for side in plan.sides]
    paired = zip(sides[::2], sides[1::2], strict=False)
    goal = (
        "; ".join(f"{one} from {other}" for one, other in paired) if len(sides) > 1 else f"the error bar of {sides[0]}"
    )
    yield f"{len(plan.settings)} of {plan.candidates} candidates, for {goal}"
    heads = [f"{name}, {unit}" if unit != "1" else name for name, unit in zip(plan.names, plan.units, strict=True)]
    rows = [("shot", *plan.setting_names, *heads, "error", "of random shots")]
    for number, sigmas in enumerate(plan.sigmas):
        shot = [f"{value:g}" for value in plan.settings[number - 1]] if number else ["-"] * len(plan.setting_names)
        errors = (plan.error[number], plan.random[number])
        rows.append((str(number or "now"), *shot, *(f"{s:.2g}" for s in sigmas), *(f"{e:.3g}" for e in errors)))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        yield "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True))
    yield "below coefficients: standard deviations, all else unknown; error: their mean as a share of the fit's priors"
    yield f"{plan.as_random:.0f} random shots would bring as much as these {len(plan.settings)}"
