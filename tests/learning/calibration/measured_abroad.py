"""What a model of several measured sets does in a set that it does not know: each of them in turn.

`python -m tests.learning.calibration.measured_abroad FOLDER[:N]... [--half 0]` calibrates every second shot of
each folder as `ballfg-train` does with several, takes what all but one have in common, observes 0.25 s of each other
shot of that one, predicts 0.3 s as `ballfg predict` does, and prints a line for it and for the nominal model. Of a
folder, the first N tracks are used.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ballfg.dynamics import load_model, nominal_model, save_model
from ballfg.estimation import dataset_surfaces
from ballfg.estimation.configure import fitted_settings
from ballfg.learning.calibration.calibrate import calibrate, with_shown_noise
from ballfg.learning.calibration.groups import OWN
from ballfg.learning.calibration.predicting import finished
from ballfg.learning.calibration.problem import pose
from ballfg.learning.calibration.sets import Abroad, OneSet
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.tracks import read_dataset, write_dataset
from tests.learning.calibration.measured_groups import Halves, errors, numbers_of


def calibrated(halves: Halves, folder: Path) -> OneSet:
    """A set, calibrated on its training half."""
    dataset = halves.written(folder, range(len(halves.train)))
    config = CalibrationConfig(split="label", groups=OWN)
    problem = pose(dataset, nominal_model(halves.info.ball), config)
    problem = with_shown_noise(replace(problem, split=replace(problem.split, judge=())))
    return OneSet(problem, finished(problem, list(calibrate(problem))[-1], errors=False).step)


def judged(halves: Halves, others: Sequence[OneSet], folder: Path) -> None:
    """Prints the lines of a set: with the nominal model, and with the one of other sets."""
    folder.mkdir()
    write_dataset(folder / "judge", halves.info, halves.judge)
    dataset, first = read_dataset(folder / "judge"), nominal_model(halves.info.ball)
    save_model(Abroad.of(others).model(first), folder / "model.yaml")
    found = []
    for name, model in (("nominal", first), ("of the others", load_model(folder / "model.yaml"))):
        found.append(errors(dataset_surfaces(dataset), model, fitted_settings(dataset, model, 0.25), halves.judge))
        print(f"{halves.info.name}, {name}: {numbers_of(found[-1])}", flush=True)
    before, after = (rows[:, 0] for rows in found)
    ratios = np.log(after / before)[np.isfinite(after + before)]
    mean, error = ratios.mean(), ratios.std(ddof=1) / np.sqrt(len(ratios))
    print(
        f"  ratio of medians {np.nanmedian(after) / np.nanmedian(before):.3f}; track by track {np.exp(mean):.3f}",
        end="",
    )
    print(f" ({np.exp(mean - error):.3f} - {np.exp(mean + error):.3f}, one standard error)", flush=True)


def main() -> None:
    """Prints the lines of each folder."""
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser()
    parser.add_argument("folders", nargs="+")
    parser.add_argument("--half", type=int, default=0, choices=(0, 1), help="which half trains")
    given = parser.parse_args()
    every = []
    for folder, _, first in (text.partition(":") for text in given.folders):
        every.append(Halves.of(Path(folder), given.half, int(first) if first else None))
    with tempfile.TemporaryDirectory() as place:
        sets = [calibrated(halves, Path(place) / f"set_{number}") for number, halves in enumerate(every)]
        for number, halves in enumerate(every):
            judged(halves, sets[:number] + sets[number + 1 :], Path(place) / f"judged_{number}")


if __name__ == "__main__":
    main()
