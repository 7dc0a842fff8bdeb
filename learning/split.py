"""Splits tracks into fitted and judging ones, before any estimate."""

import hashlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Literal

import numpy as np

from ballfg.estimation.observations.sighted_dataset import SightedDataset
from ballfg.learning.config.training import SplitConfig
from ballfg.tracks import Dataset, Track

LABEL = "split"
FIT, JUDGE, VALIDATE = "train", "test", "validation"
"""Values of the label `split`: a calibration judges by the tests, a training validates and does not use them."""


@dataclass(frozen=True)
class Split:
    """The parts of a dataset: names of the tracks that are fitted and that judge, reasons for the others by name.

    The digest is a hash of all stamps, positions, sigmas and labels, and of what is known of ball, table and noise.
    """

    fit: tuple[str, ...]
    judge: tuple[str, ...]
    left_out: dict[str, str]
    digest: str


def split_tracks(
    dataset: Dataset | SightedDataset, how: Literal["random", "label"], seed: int, *, needs_spin: bool
) -> Split:
    """Split the tracks of a dataset, in one pass.

    Args:
        how: random: half to fit, half to judge, an odd one to fit. label: by the label `split`.
        needs_spin: leave out tracks without a spin label.
    Raises: ValueError: if fewer than two tracks are left to fit or none to judge, or a label is missing.
    """
    if how == "label" and LABEL not in dataset.label_names:
        raise ValueError(f"split 'label' needs a column '{LABEL}' in labels.csv; there is none. Use split: random.")
    info, digest = dataset.info, hashlib.sha256()
    known = info.ball, info.table_height, info.table_extent, info.position_noise, info.spin_noise, info.noise
    digest.update(repr(known).encode())
    taken: dict[str, str] = {}
    left_out: dict[str, str] = {}
    for track in dataset:
        digest.update(repr((track.name, len(track), sorted(track.labels.items()))).encode())
        digest.update(track.times.tobytes() + track.positions.tobytes())
        if track.sigmas is not None:
            digest.update(track.sigmas.tobytes())
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
        got = f"{len(fit)} and {len(judge)}"
        raise ValueError(f"a calibration needs 2 tracks to fit and 1 to judge; got {got}. Add some.")
    return Split(fit, judge, left_out, digest.hexdigest())


def training_split(tracks: Sequence[tuple[int, Track]], config: SplitConfig, seed: int) -> tuple[list[int], list[int]]:
    """Numbers of the tracks that train and of those that validate, in order; other tracks are not used.

    Args: tracks: each with the number of its dataset; `alternate` counts in each dataset by itself.
    Raises: ValueError: if no track trains.
    """
    if config.by == "none":
        chosen = [FIT] * len(tracks)
    elif config.by == "label":
        chosen = [str(track.labels.get(LABEL)) for _, track in tracks]
    elif config.by == "alternate":
        counts: defaultdict[int, Iterator[str]] = defaultdict(lambda: cycle((FIT, VALIDATE)))
        chosen = [next(counts[number]) for number, _ in tracks]
    else:
        order = np.random.default_rng(seed).permutation(len(tracks))
        validating = set(order[: round(config.validation * len(tracks))].tolist())
        chosen = [VALIDATE if k in validating else FIT for k in range(len(tracks))]
    parts = [[k for k, part in enumerate(chosen) if part == wanted] for wanted in (FIT, VALIDATE)]
    if not parts[0]:
        raise ValueError(
            f"split must leave tracks to train on; got none of {len(tracks)}. Check split.by and the data."
        )
    return parts[0], parts[1]


def tracks_of(dataset: Dataset | SightedDataset, names: tuple[str, ...]) -> Iterator[Track]:
    """The tracks of some names, streamed in the order of the dataset."""
    wanted = set(names)
    return (track for track in dataset if track.name in wanted)
