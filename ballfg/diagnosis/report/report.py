"""Writes a diagnosis as `report.json` for programs, `report.html` for people, `model.yaml` for other commands."""

import glob
import json
import math
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from ballfg.diagnosis.budget import ErrorBudget
from ballfg.diagnosis.generic_test import LabelCheck
from ballfg.diagnosis.report.headline import Origin, headline
from ballfg.diagnosis.report.page import page
from ballfg.diagnosis.result import Candidate, Diagnosis, Errors, Value
from ballfg.dynamics import BallModel, save_model
from ballfg.dynamics.networks.learned_file import LEARNED
from ballfg.files.json_file import read_json
from ballfg.files.whole_folder import check_replaceable, whole_folder

REPORT: Final = "report.json"
PROGRAM: Final = "ballfg diagnose"  # Value of `program` in `report.json`: other commands write files of that name too
PAGE: Final = "report.html"
MODEL: Final = "model.yaml"


def room_file(name: str) -> str:
    """Name of the model file of one of several rooms."""
    return f"{Path(MODEL).stem}.{re.sub(r'[^A-Za-z0-9_-]', '_', name)}.yaml"


def write_report(
    diagnosis: Diagnosis,
    out: str | os.PathLike[str],
    rooms: Mapping[str, BallModel] | None = None,
    origin: Origin | None = None,
) -> None:
    """Writes `report.json`, `report.html` and `model.yaml` into a folder.

    They appear together. An earlier report is replaced: its files are listed in its `report.json`. Other files of the
    folder stay, and so do folders of weights, which copies of its models may name.

    Args:
        diagnosis: for the report.
        out: folder, new, empty or with an earlier report; its parent must exist.
        rooms: models of single rooms, by name, written beside it.
        origin: its command and files, for the page.
    Raises:
        ValueError: if `out` is a file, holds other content than a report, or a foreign file that would be replaced.
        FileNotFoundError: if its parent does not exist.
    """
    folder = Path(out).resolve()
    check_report_folder(folder)
    earlier = earlier_files(folder / REPORT) or ()
    with whole_folder(folder, earlier=[glob.escape(name) for name in earlier if LEARNED not in name]) as made:
        save_model(diagnosis.model, made / MODEL)
        for name, model in (rooms or {}).items():
            save_model(model, made / room_file(name))
        (made / PAGE).write_text(page(diagnosis, origin), encoding="utf-8")
        files = sorted({REPORT, *(entry.name for entry in made.iterdir())})
        _check_own(folder, files)
        marked = content(diagnosis) | {"program": PROGRAM, "files": files}
        text = json.dumps(marked, indent=2, allow_nan=False, ensure_ascii=False)
        (made / REPORT).write_text(text + "\n", encoding="utf-8")


def check_report_folder(folder: Path, *, force: bool = True) -> None:
    """Refuses a folder whose content must not be lost.

    Args: folder: for a report.  force: True to replace an earlier report.
    Raises:
        ValueError: if it is a file or a folder with other content than an earlier report, or with one and no force.
        FileNotFoundError: if its parent does not exist.
    """
    check_replaceable(
        folder, mark=REPORT, what="an earlier report", force=force, is_mark=lambda path: earlier_files(path) is not None
    )
    _check_own(folder, (REPORT, PAGE, MODEL))


def earlier_files(path: Path) -> list[str] | None:
    """Names of the files of an earlier diagnosis; None without its `report.json`."""
    try:
        found = read_json(path)
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None
    if not isinstance(found, dict) or found.get("program") != PROGRAM or not isinstance(found.get("files"), list):
        return None
    return [str(name) for name in found["files"]]


def _check_own(folder: Path, names: Iterable[str]) -> None:
    """Refuses to replace a file from outside of any diagnosis. Raises: ValueError."""
    own = earlier_files(folder / REPORT) or ()
    for name in names:
        if name not in own and (folder / name).exists():
            raise ValueError(
                f"out must not hold files of other programs that would be replaced; {folder / name} is none of the "
                "earlier report. Move it away, or choose another folder."
            )


def content(diagnosis: Diagnosis) -> dict[str, Any]:
    """The content of `report.json`, with null for missing numbers.

    It has no times and no paths, so that the same diagnosis gives the same bytes.
    """
    left, fallback = diagnosis.unexplained, None
    if left.fallback is not None:
        error = {"before": _errors(left.fallback.before), "after": _errors(left.fallback.after)}
        fallback = {"kind": left.fallback.kind, "description": left.fallback.description, "error": error}
    plain: dict[str, Any] = _plain(
        {
            "verdict": diagnosis.verdict.value,
            "sentence": diagnosis.sentence,
            "headline": headline(diagnosis),
            "dataset": diagnosis.dataset,
            "effects": [vars(f) | {"parameters": _values(f.parameters)} for f in diagnosis.findings],
            "error": {
                "before": _errors(diagnosis.before),
                "after": _errors(diagnosis.after),
                "unpopulated": None if diagnosis.unpopulated is None else _errors(diagnosis.unpopulated),
                "floor_mm": diagnosis.floor_mm,
                "tracks_found_on": diagnosis.tracks_found_on,
                "tracks_judged_on": diagnosis.tracks_judged_on,
            },
            "unexplained": {
                "where": left.where,
                "share_of_residual": left.share_of_residual,
                "tests": [vars(test) for test in left.tests],
                "fallback": fallback,
            },
            "calibrated": _values(diagnosis.calibrated),
            "noise": _values(diagnosis.noise),
            "rounds": [[_candidate(candidate) for candidate in row] for row in diagnosis.rounds],
            "excluded": diagnosis.excluded,
            "remarks": diagnosis.remarks,
            "probabilities": diagnosis.probabilities,
            "nothing_lacking": diagnosis.nothing_lacking,
            "nameless": diagnosis.nameless,
            "budget": None if diagnosis.budget is None else _budget(diagnosis.budget),
            "labels": None if diagnosis.labels is None else _labels(diagnosis.labels),
        }
    )
    return plain


def _labels(check: LabelCheck) -> dict[str, Any]:
    verdicts = [vars(verdict) for verdict in check.verdicts]
    contradicted = [verdict.track for verdict in check.contradicted]
    return {"p_all_right": check.p_all_right, "contradicted": contradicted, "verdicts": verdicts}


def _budget(budget: ErrorBudget) -> dict[str, Any]:
    """Parts in mm, with their sums."""
    sums = {"floor": budget.floor, "measured": budget.measured, "total": budget.total, "sentence": budget.sentence}
    return vars(budget) | sums


def _candidate(candidate: Candidate) -> dict[str, Any]:
    given = vars(candidate) | {"standing": candidate.outcome.value, "estimate": _values(candidate.estimate)}
    listed = ("name", "kind", "standing", "explained", "p_value", "delta_bic", "estimate", "seen_from", "probability")
    return {name: given[name] for name in listed}


def _errors(errors: Errors) -> dict[str, Any]:
    named = {"by_track": "by_track_mm"}
    return {named.get(name, name): value for name, value in vars(errors).items() if name != "paths"}


def _values(values: Mapping[str, Value]) -> dict[str, Any]:
    """Each with value, sigma and unit, and with the declared value, if any."""
    return {name: {k: v for k, v in vars(value).items() if v is not None} for name, value in values.items()}


def _plain(value: Any) -> Any:
    """The same for strict JSON: no NaN, no infinity, no numpy."""
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(item) for item in value]
    if value is None or isinstance(value, str | int):
        return value
    number = float(value)
    return number if math.isfinite(number) else None
