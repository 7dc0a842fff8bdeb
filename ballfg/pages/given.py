"""Recognises the arguments of `ballfg show`: a dataset, states, predictions, a diagnosis, in any order."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from pydantic import BaseModel, ConfigDict, ValidationError

from ballfg.checks import listed, short_text, shown
from ballfg.files.json_file import read_json
from ballfg.pages.tables import Kind, ResultTable, columns_of, kind_of, read_table
from ballfg.tracks import Ball, Track, read_dataset
from ballfg.tracks.info import DatasetInfo

REPORT = "report.json"  # Name of the machine-readable file in a diagnosis folder
COULD_BE = (
    "a dataset (a folder with dataset.yaml), states of `ballfg estimate`, predictions of `ballfg predict` "
    "(.csv or .parquet), or a diagnosis of `ballfg diagnose` (its folder or report.json)"
)


class Folder(Protocol):
    """A dataset to show: measured tracks, or tracks from sightings."""

    path: Path
    info: DatasetInfo
    notes: list[str]

    @property
    def ball(self) -> Ball:
        """Radius m and mass kg."""

    @property
    def names(self) -> list[str]:
        """Names of the tracks, in their order."""

    @property
    def rough(self) -> bool:
        """True if the positions were computed from sightings."""

    @property
    def has_sigmas(self) -> bool:
        """True if the samples have standard deviations."""

    def __iter__(self) -> Iterator[Track]:
        """The tracks."""


@dataclass(frozen=True, eq=False)
class Given:
    """The contents to show; None for missing ones.

    Attributes:
        dataset: the measured tracks.  states, predictions: tables of results, in the units of their columns.
        diagnosis: content of `report.json`.
    """

    dataset: Folder | None = None
    states: ResultTable | None = None
    predictions: ResultTable | None = None
    diagnosis: Mapping[str, Any] | None = None


def recognise(paths: Iterable[Path], opened: Callable[[Path], Folder] = read_dataset) -> Given:
    """Recognises and reads each path.

    Args: paths: one of each kind at most, in any order.  opened: reads a dataset.
    Raises:
        FileNotFoundError: a missing path.
        ValueError: an unrecognised path, two of one kind, or a file that breaks its format.
    """
    found: dict[str, Any] = {}
    places: dict[str, Path] = {}
    for path in paths:
        kind, content = _read(path, opened)
        if kind in found:
            raise ValueError(f"one {kind} can be shown at a time; got {places[kind]} and {path}. Leave one out.")
        found[kind], places[kind] = content, path
    if not found:
        raise ValueError(f"something must be given to show: {COULD_BE}. Name its path.")
    return Given(**found)


def _read(path: Path, opened: Callable[[Path], Folder]) -> tuple[str, Any]:
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; it could be {COULD_BE}. Check the path.")
    if path.is_dir():
        if (path / "dataset.yaml").is_file():
            return "dataset", opened(path)
        if (path / REPORT).is_file():
            return "diagnosis", _diagnosis(path / REPORT)
        raise ValueError(f"{path} must be {COULD_BE}; it holds neither dataset.yaml nor {REPORT}. Check the path.")
    if path.suffix.lower() == ".json":
        return "diagnosis", _diagnosis(path)
    if path.suffix.lower() not in (".csv", ".parquet"):
        raise ValueError(f"{path} must be {COULD_BE}; its ending is {path.suffix or 'none'!r}. Check the path.")
    columns = columns_of(path)
    own = path.absolute().parent / "dataset.yaml"
    kind = None if own.is_file() and path.stem == "tracks" else kind_of(columns)
    if kind is None:
        hint = f"Give its folder, {path.parent}." if own.is_file() else "Check the path."
        raise ValueError(f"{path} must be {COULD_BE}; its columns are {listed(columns)}. {hint}")
    return ("states" if kind is Kind.STATES else "predictions"), read_table(path, kind)


def _diagnosis(path: Path) -> Mapping[str, Any]:
    try:
        content = read_json(path)
    except ValueError:
        raise ValueError(f"{path} must be the {REPORT} of a diagnosis; it is no JSON. Diagnose again.") from None
    if not isinstance(content, dict) or not {"verdict", "sentence", "error", "calibrated", "rounds"} <= content.keys():
        raise ValueError(f"{path} must be the {REPORT} of a diagnosis; its fields are others. Give {COULD_BE}.")
    try:
        _Report.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        where = short_text(".".join(str(part) for part in first["loc"]))
        raise ValueError(
            f"{path} must be the {REPORT} of a diagnosis; {where}: {first['msg']}, got {shown(first['input'])}. "
            "Diagnose again."
        ) from None
    return content


class _Part(BaseModel):
    """A part of a report; other fields are ignored."""

    model_config = ConfigDict(strict=True, frozen=True, allow_inf_nan=False)


class _Errors(_Part):
    prediction_rmse_mm: float | None = None
    apex_rmse_mm: float | None = None
    nis: float | None = None
    intervals_held: float | None = None
    by_track_mm: list[float | None] = []


class _BeforeAfter(_Part):
    before: _Errors
    after: _Errors


class _Value(_Part):
    declared: float | None = None
    value: float | None
    sigma: float | None
    unit: str


class _Effect(_Part):
    name: str
    sentence: str


class _Candidate(_Part):
    name: str
    explained: float | None = None
    standing: str


class _Report(_Part):
    """The parts of a report that pages show."""

    verdict: str
    sentence: str
    error: _BeforeAfter
    calibrated: dict[str, _Value]
    rounds: list[list[_Candidate]]
    effects: list[_Effect] = []
    dataset: str = ""
