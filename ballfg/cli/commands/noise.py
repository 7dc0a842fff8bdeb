"""Implements `ballfg noise`, which estimates the noise of a dataset's tracks, with error bars."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ballfg.cli import inputs
from ballfg.progress import counted, progress

if TYPE_CHECKING:
    from ballfg.dynamics import BallModel
    from ballfg.estimation.noise.estimate import NoiseEstimate
    from ballfg.estimation.observations.sighted_dataset import SightedDataset
    from ballfg.tracks import Dataset

MEANINGS = {
    "position": ("error of a position, new in each sample, along {}", 1e3, "mm", 0.5),
    "memory": ("error of a position that lasts, along {}", 1e3, "mm", 0.5),
    "memory_time": ("time over which it lasts", 1e3, "ms", math.inf),
    "stamp_jitter": ("error of a stamp", 1e3, "ms", 0.05),
    "spin_label": ("error of a spin label, per axis", 1.0, "rad/s", 2000.0),
    "spin_prior": ("spin of a ball without a label, per axis", 1.0, "rad/s", 2000.0),
    "acceleration": ("acceleration that the model lacks", 1.0, "m/s^2/sqrt(Hz)", 100.0),
    "contact_velocity": ("scatter of the velocity after a bounce", 1.0, "m/s", 20.0),
    "contact_tangential": ("the same, in addition, along the surface", 1.0, "m/s", 20.0),
    "contact_spin": ("scatter of the spin after a bounce", 1.0, "rad/s", 2000.0),
    "coefficients": ("spread of {} / its usual one", 1.0, "", 30.0),
}
"""Meaning of each number, factor to its printed unit, that unit, and in SI units the largest of a tracked ball."""
UNKNOWN = 0.7  # Standard deviation of a logarithm beyond which the tracks give hardly more than the order of magnitude

MOST_ERROR = 3.0  # The same that is printed at most, a factor of 20: beyond, the limits say what is known

PRIOR = 1.2  # The same of positions from which the tracks say nothing: it is the prior's
STREAK = ("error of a sighting, along each axis", "in addition, along its streak")
LEAST_STREAK = 0.01  # Share of a sighting's error below which it has no streak


def noise(
    dataset: inputs.DatasetFolder,
    model: inputs.ModelFile = None,
    effects_file: inputs.EffectsFiles = None,
    observations_file: inputs.ObservationsFiles = None,
    tracks: Annotated[int, typer.Option(min=5, help="Number of tracks that are used, evenly over the dataset.")] = 80,
    out: Annotated[
        Path | None, typer.Option(metavar="<path>", help="Model file to write: the model with this noise.")
    ] = None,
    write: Annotated[bool, typer.Option("--write", help="Write the noise into the dataset's dataset.yaml.")] = False,
    anyway: inputs.Anyway = False,
    source: inputs.SourceName = None,
) -> None:
    """The noise of the tracker, of flights, bounces, labels and spins that the tracks of a dataset show.

    From detections it is the noise of each camera's pixels, beside the stated one.

    It is the noise with which forecasts 20 to 300 ms ahead, within the tracks, are most probable. The model stays as it
    is: an effect that it lacks counts as noise. `estimate` and `predict` do the same where neither dataset.yaml nor the
    model states the noise.

    Example: ballfg noise data/ballgun --out noisy.yaml
    """
    from ballfg.dynamics.compiled.kept_model import whole
    from ballfg.estimation import dataset_settings, dataset_surfaces, estimate_noise
    from ballfg.estimation.configure import usual_settings
    from ballfg.estimation.noise.estimate import held_with, spread_over
    from ballfg.estimation.reading import with_readings
    from ballfg.tracks import read_dataset

    inputs.know(effects_file, observations_file)
    if inputs.is_sighted(source, dataset):
        if out is not None or write:
            raise ValueError(
                "--out and --write must be left out for detections: models and dataset.yaml hold no pixels"
            )
        _of_pixels(inputs.open_source("detections", dataset, model).changing(), tracks)
        return
    if out is not None:
        inputs.check_model_out(out)
    data = with_readings(read_dataset(dataset))
    ball = whole(inputs.open_model(data, model))
    data = inputs.flights_only(data, anyway).dataset
    surfaces, chosen = dataset_surfaces(data), spread_over(data, len(data), tracks)
    assumed, usual = dataset_settings(data, ball), usual_settings(data, ball)
    found = estimate_noise(ball, surfaces, usual, chosen, watch=progress)
    if found is None:
        raise ValueError(f"{dataset} must hold tracks with undisturbed flights of 0.1 s or more; none has one")
    check_known(found, dataset)
    forecasts = counted(found.starts, "forecast")
    print(f"{dataset}: noise from {counted(found.tracks, 'track')}, {forecasts} of up to 0.3 s in them")
    for line in _table(found):
        print(line)
    if assumed == usual:
        before = found.held_before
    elif assumed == found.settings:
        before = found.held
    else:
        before = held_with(ball, surfaces, assumed, chosen)
    print(
        f"90 % intervals of these forecasts hold {100 * found.held:.0f} %; with the noise assumed so far "
        f"{100 * before:.0f} %"
    )
    _write(found, data, ball, out, write)


def _of_pixels(given: "inputs.Inputs[SightedDataset]", most: int) -> None:
    """Prints the noise of each camera's sightings."""
    from ballfg.estimation import Settings, Smoother
    from ballfg.estimation.noise.estimate import spread_over
    from ballfg.estimation.noise.sightings import noise_of_sightings

    data = given.dataset
    chosen = spread_over(data, len(data), most)
    smoother = Smoother(given.model, given.surfaces, Settings.for_measured(given.model))
    print(f"{data.path}: noise of pixels from {counted(len(chosen), 'track')}")
    for one in noise_of_sightings(smoother, chosen):
        print(f"  camera {one.camera}, {one.count} sightings")
        rows = zip(STREAK, one.sigmas, one.errors, one.stated, strict=True)
        for name, sigma, error, stated in rows:
            if stated > LEAST_STREAK * one.stated[0]:
                print(f"    {name:50} {sigma:8.3g} x/: {math.exp(error):4.2f}  px  (stated {stated:.3g})")


def check_known(found: "NoiseEstimate", dataset: Path) -> None:
    """Refuses noise that the tracks do not show, or that no ball has. Raises: ValueError."""
    positions = [name for name in found.relative_errors if name.startswith("position")]
    unknown = min((found.relative_errors[name] for name in positions), default=0.0) >= PRIOR
    unknown = unknown and all(math.isinf(found.intervals[name][1]) for name in positions)  # else they are exact
    absurd, numbers = list[str](), _numbers(found)
    for field, (meaning, _, _, most) in MEANINGS.items():
        largest = max((number for name, number in numbers.items() if name.split(".")[0] == field), default=0.0)
        if largest > most:
            absurd.append(f"{meaning.partition(',')[0].format('a coefficient')} {largest:.2g}")
    if unknown or absurd:
        why = f"it would be: {', '.join(absurd)}" if absurd else f"they allow {found.starts} forecasts only"
        raise ValueError(
            f"{dataset} must show its noise; its {found.tracks} tracks do not: {why}. Check that they are flights of "
            "this ball, or give more and longer ones; without, the usual noise is used."
        )


def _numbers(found: "NoiseEstimate") -> dict[str, float]:
    """All numbers in SI units, by their names in `NoiseEstimate.relative_errors`."""
    content: dict[str, Any] = found.noise.to_mapping() | {"coefficients": found.coefficient_factors}
    numbers: dict[str, float] = {}
    for field, value in content.items():
        if isinstance(value, float):
            numbers[field] = value
        else:
            parts = value if isinstance(value, dict) else dict(zip("xyz", value, strict=True))
            numbers |= {f"{field}.{part}": number for part, number in parts.items()}
    return numbers


def _table(found: "NoiseEstimate") -> list[str]:
    lines, numbers = [], _numbers(found)
    for name, error in found.relative_errors.items():
        field, _, axis = name.partition(".")
        meaning, factor, unit, _ = MEANINGS[field]
        number = factor * numbers[name]
        doubt = "  (hardly known)" if error >= UNKNOWN else ""
        limits = _limits(*(factor * limit for limit in found.intervals[name]))
        factor_of_error = math.exp(min(error, MOST_ERROR))
        lines.append(f"  {meaning.format(axis):52} {number:8.3g} x/: {factor_of_error:4.2f}  {unit}{limits}{doubt}")
    return lines


def _limits(low: float, high: float) -> str:
    """The interval of a number, or its only limit."""
    if math.isinf(high):
        return f"  (above {low:.2g})" if low > 0.0 else ""
    return f"  ({low:.2g} to {high:.2g})" if low > 0.0 else f"  (below {high:.2g})"


def _write(found: "NoiseEstimate", data: "Dataset", ball: "BallModel", out: Path | None, write: bool) -> None:
    from dataclasses import replace

    from ballfg.dynamics import save_model
    from ballfg.tracks.info import INFO_FILE, write_info

    if out is not None:
        ball.noise = found.noise
        save_model(ball, out)
        print(f"{out}: the model with this noise")
    if write:
        path = data.path / INFO_FILE
        write_info(path, replace(data.info, noise=found.noise))
        print(f"{path}: states this noise now")
    if out is None and not write:
        print("Write it with --out MODEL.yaml into a model file, or with --write into dataset.yaml.")
