"""Reads the pairs of effects that a diagnosis could not separate."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from ballfg.checks import one_line, short_text
from ballfg.diagnosis.hypotheses.hypothesis import TWINS
from ballfg.diagnosis.report.report import REPORT
from ballfg.diagnosis.result import Diagnosis
from ballfg.dynamics import EFFECTS
from ballfg.files.json_file import read_json


def pairs_of(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """Pairs of a diagnosis: an added effect and one that would have explained as much.

    Raises: ValueError: if there is no such pair.
    """
    return _pairs({f.name: f.indistinguishable_from for f in diagnosis.findings}, "the diagnosis")


def reported_pairs(folder: Path) -> list[tuple[str, str]]:
    """Pairs of a diagnosis in a folder.

    Raises: FileNotFoundError: no report there. ValueError: a file that is no report, or no pair in it.
    """
    path = folder / REPORT
    if not path.is_file():
        raise FileNotFoundError(f"diagnosis must be a folder with {REPORT}; {folder} has none. Run ballfg diagnose.")
    try:
        effects = read_json(path)["effects"]
        found = {str(e["name"]): [str(name) for name in e["indistinguishable_from"]] for e in effects}
    except (ValueError, KeyError, TypeError) as error:
        said = short_text(one_line(error))
        raise ValueError(f"{path} is not the report of a diagnosis ({said}). Run ballfg diagnose again.") from None
    return _pairs(found, str(path))


def _pairs(alike: Mapping[str, Sequence[str]], where: str) -> list[tuple[str, str]]:
    """Pairs of registered effects, without twins, which no shot separates."""
    pairs = [
        (name, other)
        for name, others in alike.items()
        for other in others
        if name in EFFECTS and other in EFFECTS and other not in TWINS.get(name, ())
    ]
    if not pairs:
        raise ValueError(
            f"{where} names no pair of effects that it could not tell apart. Say what the shots are for with --between "
            "or --shrink."
        )
    return pairs
