"""A diagnosis as files: `report.json` for programs, `report.html` for people, `model.yaml` for other commands."""

from __future__ import annotations

import json
import math
import os
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from ballfg.diagnosis.report.page import page
from ballfg.diagnosis.result import Candidate, Diagnosis, Errors, Fallback, Value
from ballfg.dynamics import save_model

REPORT: Final = "report.json"
"""Written last, so that the other files are complete where it exists."""
PAGE: Final = "report.html"
MODEL: Final = "model.yaml"


def write_report(diagnosis: Diagnosis, out: str | os.PathLike[str]) -> None:
    """Write `report.json`, `report.html` and `model.yaml` into a folder.

    The files are made in a folder beside it and moved at the end. A new folder thus appears at once; an earlier report
    is replaced file by file. Other files of the folder stay.

    Args:
        diagnosis: to report.
        out: folder, new, empty or with an earlier report; its parent must exist.

    Raises:
        ValueError: if `out` is a file or holds other things than a report.
        FileNotFoundError: if its parent does not exist.
    """
    check_report_folder(Path(out))
    folder = Path(out).resolve()
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", suffix=".part", dir=folder.parent) as temporary:
        made = Path(temporary) / "report"
        made.mkdir()
        save_model(diagnosis.model, made / MODEL)
        (made / PAGE).write_text(page(diagnosis), encoding="utf-8")
        text = json.dumps(content(diagnosis), indent=2, allow_nan=False, ensure_ascii=False)
        (made / REPORT).write_text(text + "\n", encoding="utf-8")
        _move(made, folder)


def check_report_folder(folder: Path) -> None:
    """Refuse a folder whose content must not be lost.

    Raises:
        ValueError: if it is a file or a folder with other content than an earlier report.
        FileNotFoundError: if its parent does not exist.
    """
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"out must be a folder; {folder} is a file. Choose another name.")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / REPORT).is_file():
        raise ValueError(
            f"out must be new, empty or hold an earlier report; {folder} holds other files. Choose another name."
        )
    if not folder.absolute().parent.is_dir():
        raise FileNotFoundError(f"out must be in an existing folder; {folder.parent} is none. Create it first.")


def _move(made: Path, folder: Path) -> None:
    """Give a folder its final name; where it is there already, replace its files, `report.json` last."""
    if not folder.exists():
        os.rename(made, folder)
        return
    new = {path.name: path for path in made.iterdir()}
    for name in sorted(new, key=lambda name: (name == REPORT, new[name].is_file())):
        if not (folder / name).is_dir():  # a folder's name holds a digest of its content: the same one may stay
            os.replace(new[name], folder / name)
    for path in folder.glob(f"{Path(MODEL).stem}.learned-*"):
        if path.name not in new:
            shutil.rmtree(path)


def content(diagnosis: Diagnosis) -> dict[str, Any]:
    """The content of `report.json`, with null for missing numbers.

    It has no times and no paths, so that the same diagnosis gives the same bytes.
    """
    left = diagnosis.unexplained
    plain: dict[str, Any] = _plain(
        {
            "verdict": diagnosis.verdict.value,
            "sentence": diagnosis.sentence,
            "dataset": diagnosis.dataset,
            "effects": [vars(f) | {"parameters": _values(f.parameters)} for f in diagnosis.findings],
            "error": {
                "before": _errors(diagnosis.before),
                "after": _errors(diagnosis.after),
                "tracks_found_on": diagnosis.tracks_found_on,
                "tracks_judged_on": diagnosis.tracks_judged_on,
            },
            "unexplained": {
                "where": left.where,
                "share_of_residual": left.share_of_residual,
                "tests": [vars(test) for test in left.tests],
                "fallback": None if left.fallback is None else _fallback(left.fallback),
            },
            "calibrated": _values(diagnosis.calibrated),
            "noise": _values(diagnosis.noise),
            "rounds": [[_candidate(candidate) for candidate in row] for row in diagnosis.rounds],
            "excluded": diagnosis.excluded,
        }
    )
    return plain


def _candidate(candidate: Candidate) -> dict[str, Any]:
    return {
        "name": candidate.name,
        "kind": candidate.kind,
        "standing": candidate.outcome.value,
        "explained": candidate.explained,
        "p_value": candidate.p_value,
        "delta_bic": candidate.delta_bic,
        "estimate": _values(candidate.estimate),
    }


def _errors(errors: Errors) -> dict[str, Any]:
    named = {"by_track": "by_track_mm"}
    return {named.get(name, name): value for name, value in vars(errors).items()}


def _fallback(fallback: Fallback) -> dict[str, Any]:
    error = {"before": _errors(fallback.before), "after": _errors(fallback.after)}
    return {"kind": fallback.kind, "description": fallback.description, "error": error}


def _values(values: Mapping[str, Value]) -> dict[str, Any]:
    """Each with value, sigma and unit, and with the declared value where there is one."""
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
