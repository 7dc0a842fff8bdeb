"""What a misspelt name was probably meant to be."""

import difflib
from collections.abc import Iterable

_SYNONYMS = {
    "t": ("time", "timestamp", "stamp", "times", "time_s", "t_s"),
    "trajectory": ("track", "track_id", "trajectory_id", "id", "name", "shot"),
    "x": ("pos_x", "px", "x_m"),
    "y": ("pos_y", "py", "y_m"),
    "z": ("pos_z", "pz", "z_m"),
    "licence": ("license",),
}


def nearest(name: str, candidates: Iterable[str]) -> str | None:
    """The candidate most like `name` (spaces, case and common synonyms set aside), or None if none is near."""
    plain = {candidate.strip().lower(): candidate for candidate in candidates}
    wanted = name.strip().lower()
    for main, others in _SYNONYMS.items():
        group = (main, *others)
        if wanted in group:
            for other in group:
                if other in plain:
                    return plain[other]
    found = difflib.get_close_matches(wanted, plain, n=1, cutoff=0.6)
    return plain[found[0]] if found else None


def did_you_mean(name: str, candidates: Iterable[str]) -> str:
    """`" Did you mean 'x'?"`, or empty text if nothing is near."""
    found = nearest(name, candidates)
    return "" if found is None else f" Did you mean {found!r}?"
