"""Implements `ballfg diagnose`, which finds effects that a model lacks from the tracks of a dataset."""

import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ballfg.cli import inputs
from ballfg.progress import announce

if TYPE_CHECKING:
    from ballfg.diagnosis.result import Diagnosis


NAME_AT = 0.9  # Probability from which on an effect is named


def diagnose(
    datasets: inputs.DatasetFolders,
    out: Annotated[Path, typer.Option(help="Folder of the report, new or empty.")],
    model: Annotated[Path | None, typer.Option(help="Model file. Default: the nominal model of the ball.")] = None,
    effects_file: inputs.EffectsFiles = None,
    observations_file: inputs.ObservationsFiles = None,
    name_at: Annotated[float, typer.Option(help="Probability from which on an effect is named.")] = NAME_AT,
    source: inputs.SourceName = None,
    anyway: inputs.Anyway = False,
    jobs: inputs.Jobs = inputs.CORES,
    cluster: inputs.Cluster = None,
    address: inputs.Address = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier report.")] = False,
) -> None:
    """Find effects that the model lacks, with their evidence, their alternatives and the gain in prediction.

    Example: ballfg diagnose data/aimy --model model.yaml --out diagnosis

    One half of the tracks is searched for effects. The other half is held out to
    evaluate them. The folder holds the report to read (report.html), the same
    for programs (report.json), and the corrected model for the --model of other
    commands (model.yaml).

    From the detections of one camera all strokes are searched, for what the
    ball's laws lack and for errors of the camera's clock and lens.

    Several datasets are diagnosed together: the ball is the same, rooms and rigs
    are their own. model.yaml is then the ball's, for a room that had no part, and
    model.NAME.yaml that of each room.
    """
    from ballfg.checks import check_range
    from ballfg.diagnosis import diagnose as find, diagnose_jointly
    from ballfg.diagnosis.one_view.diagnosis import diagnose_one_view
    from ballfg.diagnosis.report.headline import Origin
    from ballfg.diagnosis.report.report import MODEL, PAGE, REPORT, check_report_folder, room_file, write_report
    from ballfg.dynamics import AnalyticModel
    from ballfg.estimation.observations.sighted_dataset import SightedDataset
    from ballfg.files.whole_folder import reserved

    check_range("--name-at", name_at, 0.0, 1.0)
    if any(out.resolve() == dataset.resolve() for dataset in datasets):
        raise ValueError(f"out must not be the dataset itself; got {out}. Choose another folder.")
    if model is not None and model.resolve() == out.resolve() / MODEL:
        raise ValueError(f"out must not hold the model itself; {model} would be replaced. Choose another folder.")
    with reserved(out):  # until the report is written: a diagnosis takes minutes
        check_report_folder(out, force=force)
        inputs.know(observations=observations_file)
        opened, *others = [
            inputs.open_source(source, dataset, model, effects_file).changing().in_flight(anyway)
            for dataset in datasets
        ]
        sighted = [isinstance(one.dataset, SightedDataset) for one in (opened, *others)]
        if others and any(sighted):
            raise ValueError("several datasets must have positions; got detections. Diagnose each camera's alone.")
        if not isinstance(opened.model, AnalyticModel):
            raise ValueError(
                f"--model must be analytic: a diagnosis adds physical effects to it; {model} is a learned one. "
                "Give the analytic model that you believe in."
            )
        rooms: dict[str, AnalyticModel] = {}
        with inputs.workers(cluster, address, jobs) as processes:
            if others:
                together = [opened.dataset, *(other.dataset for other in others)]
                joint = diagnose_jointly(together, opened.model, jobs=processes, watch=announce, name_at=name_at)
                diagnosis, rooms = joint.whole, joint.rooms
            elif sighted[0]:
                diagnosis = diagnose_one_view(
                    opened.dataset, opened.model, jobs=processes, watch=announce, name_at=name_at
                )
            else:
                diagnosis = find(opened.dataset, opened.model, jobs=processes, watch=announce, name_at=name_at)
        typed = _typed(datasets, model, effects_file, observations_file, name_at, source, out)
        models = tuple(map(room_file, rooms)) or (MODEL,)
        origin = Origin(
            typed, tuple(map(str, datasets)), "" if model is None else str(model), str(out), models, opened.doubts
        )
        write_report(diagnosis, out, rooms, origin)
    print(*_summary(diagnosis), sep="\n")
    if rooms:
        print("", *diagnosis.remarks[: len(rooms) + 2], sep="\n")
    files = (PAGE, REPORT, MODEL, *map(room_file, rooms))
    print(f"\nwrote {', '.join(name for name in files if (out / name).is_file())} to {out}")


def _typed(
    datasets: Sequence[Path],
    model: Path | None,
    effects: Sequence[Path] | None,
    observations: Sequence[Path] | None,
    name_at: float,
    source: str | None,
    out: Path,
) -> str:
    """The command line, without options that do not change the result."""
    words = ["ballfg", "diagnose", *map(str, datasets)]
    words += [] if model is None else ["--model", str(model)]
    words += [word for path in effects or () for word in ("--effects-file", str(path))]
    words += [word for path in observations or () for word in ("--observations-file", str(path))]
    words += [] if name_at == NAME_AT else ["--name-at", f"{name_at:g}"]
    words += [] if source is None else ["--from", source]
    return shlex.join([*words, "--out", str(out)])


def _summary(diagnosis: "Diagnosis") -> Iterator[str]:
    """The diagnosis in lines: the sentence, effects, errors on the held-out half, the rest."""
    from ballfg.checks import aligned
    from ballfg.diagnosis.report.headline import headline, of_population
    from ballfg.diagnosis.report.wording import fixed, listed, odds, probability

    yield headline(diagnosis)
    yield f"{diagnosis.verdict.value}: {diagnosis.sentence}"
    rows = [("effect", "probability", "kind", "by chance", "BIC", "cannot be told from", "coefficients")]
    for f in diagnosis.findings:
        others = ", ".join(f.indistinguishable_from) or "-"
        chance, bic = probability(f.p_value), f"{f.delta_bic:+.0f}"
        there = odds(f.probability) + (f" (one of them {odds(f.together)})" if f.indistinguishable_from else "")
        rows.append((f.name, there, f.kind, chance, bic, others, listed(f.parameters)))
    if diagnosis.findings:
        yield from ("", *aligned(rows))
    before, after = diagnosis.before, diagnosis.after
    errors = [
        (f"on {diagnosis.tracks_judged_on} judging tracks", "before", "after"),
        ("prediction RMSE, mm", fixed(before.prediction_rmse_mm, 1), fixed(after.prediction_rmse_mm, 1)),
        ("apex RMSE, mm", fixed(before.apex_rmse_mm, 1), fixed(after.apex_rmse_mm, 1)),
        ("NIS (1 is right)", fixed(before.nis, 2), fixed(after.nis, 2)),
        ("intervals hold, %", fixed(100 * before.intervals_held, 0), fixed(100 * after.intervals_held, 0)),
        ("log likelihood", fixed(before.log_likelihood, 2), fixed(after.log_likelihood, 2)),
    ]
    yield from ("", *aligned(errors))
    if told := of_population(diagnosis):
        yield told
    left = diagnosis.unexplained
    if left.where:
        yield from ("", f"left unexplained: {left.where}")
    if left.fallback is not None:
        error = left.fallback.after.prediction_rmse_mm
        yield f"  {left.fallback.kind}: {left.fallback.description}; prediction RMSE {error:.1f} mm with it"
    if diagnosis.excluded:
        yield from ("", *(f"left out: {line}" for line in diagnosis.excluded))
