"""Which tracks are fitted and which judge the result; decided before anything is estimated."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ballfg.tracks import Dataset, Track

LABEL = "split"
FIT, JUDGE = "train", "test"
"""Values of the label `split`; tracks with another value take no part."""


@dataclass(frozen=True)
class Split:
    """The parts of a dataset.

    Attributes:
        fit: names of the tracks that are fitted.  judge: of those that judge.
        left_out: why other tracks take no part, by name.
        digest: of all stamps, positions, sigmas and labels: another dataset has another one.
    """

    fit: tuple[str, ...]
    judge: tuple[str, ...]
    left_out: dict[str, str]
    digest: str


def split_tracks(dataset: Dataset, how: Literal["random", "label"], seed: int, *, needs_spin: bool) -> Split:
    """Part the tracks of a dataset, in one pass.

    Args:
        dataset: the tracks.
        how: random: half to each, the odd one to fit. label: by the label `split`.
        seed: of the random split.
        needs_spin: leave out tracks without a spin label.

    Raises: ValueError: if fewer than two tracks are left to fit or none to judge, or a label is missing.
    """
    if how == "label" and LABEL not in dataset.label_names:
        raise ValueError(f"split 'label' needs a column '{LABEL}' in labels.csv; there is none. Use split: random.")
    digest = hashlib.sha256()
    taken: dict[str, str] = {}
    left_out: dict[str, str] = {}
    for track in dataset:
        _add(digest, track)
        label = str(track.labels.get(LABEL, "none"))
        if needs_spin and track.spin_label is None:
            left_out[track.name] = "no spin label"
        elif how == "label" and label not in (FIT, JUDGE):
            left_out[track.name] = f"label {LABEL} is {label}, neither {FIT} nor {JUDGE}"
        else:
            taken[track.name] = label
    if needs_spin and not taken:
        raise ValueError(
            "a coefficient that acts on the spin needs tracks with spin labels (spin_x, spin_y, spin_z in labels.csv); "
            "this dataset has none. Take it out of coefficients."
        )
    names = list(taken)
    if how == "random":
        order = np.random.default_rng(seed).permutation(len(names))
        fitted = {names[i] for i in order[: (len(names) + 1) // 2]}
    else:
        fitted = {name for name, label in taken.items() if label == FIT}
    fit = tuple(name for name in names if name in fitted)
    judge = tuple(name for name in names if name not in fitted)
    if len(fit) < 2 or not judge:
        raise ValueError(
            f"a calibration needs 2 tracks to fit and 1 to judge; got {len(fit)} and {len(judge)}. Add some."
        )
    return Split(fit, judge, left_out, digest.hexdigest())


def tracks_of(dataset: Dataset, names: tuple[str, ...]) -> Iterator[Track]:
    """The tracks of some names, streamed in the order of the dataset."""
    wanted = set(names)
    return (track for track in dataset if track.name in wanted)


def _add(digest: hashlib._Hash, track: Track) -> None:
    digest.update(repr((track.name, len(track), sorted(track.labels.items()))).encode())
    digest.update(track.times.tobytes() + track.positions.tobytes())
    if track.sigmas is not None:
        digest.update(track.sigmas.tobytes())
