"""Implements `ballfg predict`, which predicts the later positions of every track from its first part."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ballfg.cli import inputs
from ballfg.progress import progress

if TYPE_CHECKING:
    import numpy as np

    from ballfg.estimation import ConformalScales, Estimator
    from ballfg.estimation.track_prediction import TrackPrediction
    from ballfg.tracks import Dataset


def predict(
    dataset: inputs.DatasetFolder,
    observe: Annotated[float, typer.Option(help="Observed time from the start of each track, s.")],
    out: inputs.OutTable,
    method: inputs.MethodName = "smoother",
    solver: inputs.SolverName = None,
    model: inputs.ModelFile = None,
    group: inputs.GroupName = None,
    ball: inputs.BallName = None,
    source: inputs.SourceName = None,
    effects_file: inputs.EffectsFiles = None,
    observations_file: inputs.ObservationsFiles = None,
    conformal: Annotated[
        Path | None,
        typer.Option(
            help="Dataset of calibration tracks of the same kind, or the file of --save-conformal: sigmas are scaled "
            "so that +-1.645 of them hold 90 % of the measured coordinates."
        ),
    ] = None,
    save_conformal: Annotated[
        Path | None, typer.Option(help="YAML file to keep the scales of --conformal in, for later predictions.")
    ] = None,
    jobs: inputs.Jobs = inputs.CORES,
    cluster: inputs.Cluster = None,
    address: inputs.Address = None,
) -> None:
    """Positions at every stamp after the observed part, with the standard deviation of a measurement there.

    These are the positions that will be measured: measurement effects of the model file are included. A network that
    knows where it was trained adds the column outside: 0 there, 1 far from it.

    From detections, they are the ball's positions, and the error stated at the end is the distance from the rough ones
    that all sightings give.

    Where the observed part of a track could not be estimated, its prediction is wide; such tracks are listed, and the
    exit status is 3.

    Example: ballfg predict data/ballgun --observe 0.25 --out predictions.csv
    """
    from ballfg.estimation import predict_tracks
    from ballfg.estimation.track_prediction import check_observe
    from ballfg.files.whole_file import check_file
    from ballfg.tracks import TableWriter

    outcome = _Outcome()
    with TableWriter(out) as table, inputs.workers(cluster, address, jobs) as workers:
        inputs.check_out(out, dataset)
        check_observe(observe)
        if save_conformal is not None:
            check_file(save_conformal, "save_conformal")
            if conformal is None:
                raise ValueError("save_conformal must come with --conformal, whose scales it keeps. Add --conformal.")
        inputs.know_observations(observations_file)
        opened = inputs.open_source(source, dataset, model, effects_file, observe, ball)
        count = len(opened.dataset)
        estimator = opened.estimator(method, solver, group)
        scales = None
        if conformal is not None and opened.dataset.rough:
            raise ValueError(
                "conformal must not be given with detections: its scales are those of positions. Leave it out."
            )
        if conformal is not None:
            scales = _conformal_scales(conformal, opened.dataset, estimator, method, observe, workers)
        predictions = predict_tracks(estimator, opened.dataset, count, observe, jobs=workers)
        for plain in progress(predictions, count, "tracks predicted"):
            result = plain if scales is None else scales.scaled(plain)
            columns: dict[str, str | np.ndarray] = {"trajectory": result.name, "t": result.times}
            columns |= dict(zip(("x", "y", "z"), result.positions.T, strict=True))
            columns |= dict(zip(("sigma_x", "sigma_y", "sigma_z"), result.sigmas.T, strict=True))
            table.write(columns if result.outside is None else columns | {"outside": result.outside})
            outcome.add(result, plain.sigmas)
    print(f"{out}: {outcome.rows} positions of {count} tracks, from the first {observe:g} s of each by {method}")
    outcome.print(observe)
    outcome.tracks.print_outside()
    if scales is not None:
        _print_conformal(scales, outcome)
        if save_conformal is not None:
            scales.save(save_conformal)
            print(f"{save_conformal}: the scales, for --conformal")
    outcome.tracks.end()


def _conformal_scales(
    source: Path,
    dataset: Dataset,
    estimator: Estimator,
    method: str,
    observe: float,
    jobs: int,
) -> ConformalScales:
    """Scales from the calibration tracks of a folder, or from a file of scales."""
    from ballfg.estimation import ConformalScales, predict_tracks
    from ballfg.estimation.conformal import check_calibration_tracks, load_conformal
    from ballfg.estimation.reading import with_readings
    from ballfg.tracks import read_dataset

    if source.is_file():
        scales = load_conformal(source)
        scales.check_fits(observe, method)
        return scales
    calibration = with_readings(read_dataset(source))
    check_calibration_tracks(calibration, dataset)
    inputs.print_notes(f"calibration tracks: {note}" for note in calibration.notes)
    count = len(calibration)
    predictions = predict_tracks(estimator, calibration, count, observe, jobs=jobs)
    watched = progress(predictions, count, "calibration tracks predicted")
    return ConformalScales.of(watched, calibration.info.name, observe, method)


def _print_conformal(scales: ConformalScales, outcome: _Outcome) -> None:
    """Prints the coverage of the intervals, on calibration and predicted tracks, and where they are infinite."""
    from ballfg.estimation import Status
    from ballfg.estimation.conformal import BIN, FEWEST

    what = "the model's own hold {:.0f} %, the conformal ones {:.0f} %"
    if (scales.tracks > FEWEST).any():
        count, own, held = sum(scales.statuses.values()), 100 * scales.own_coverage, 100 * scales.coverage
        print(f"  90 % intervals on the {count} calibration tracks of {scales.source!r}: {what.format(own, held)}")
    for text, number in scales.statuses.items():
        if text != Status.OK.value:
            print(f"  {number} calibration track{'s' if number > 1 else ''}: {text}")
    if outcome.finite:
        own, held = 100 * outcome.held_by_own / outcome.finite, 100 * outcome.held / outcome.finite
        print(f"  90 % intervals on the {outcome.tracks.statuses.total()} predicted tracks: {what.format(own, held)}")
    infinite = 3 * outcome.rows - outcome.finite
    if infinite:
        inputs.print_notes(
            [
                f"{infinite} of {3 * outcome.rows} sigmas are infinite: a finite 90 % interval needs {FEWEST} "
                f"calibration tracks with samples as far ahead; up to {BIN * len(scales.tracks):g} s there are so many"
            ]
        )


@dataclass
class _Outcome:
    rows: int = 0
    squares: float = 0.0
    ended: int = 0
    held: int = 0
    held_by_own: int = 0
    finite: int = 0
    tracks: inputs.Outcome = field(default_factory=inputs.Outcome)

    def add(self, result: TrackPrediction, own_sigmas: np.ndarray) -> None:
        """Counts a track, with the coordinates inside their finite 90 % intervals."""
        import numpy as np

        from ballfg.estimation.conformal import HALF_WIDTH

        errors = np.abs(result.positions - result.measured)
        finite = np.isfinite(result.sigmas)
        self.rows += len(result.times)
        self.squares += float((errors**2).sum())
        self.ended += len(result.times) == 0
        self.finite += int(finite.sum())
        self.held += int((finite & (errors <= HALF_WIDTH * result.sigmas)).sum())
        self.held_by_own += int((finite & (errors <= HALF_WIDTH * own_sigmas)).sum())
        outside = None if result.outside is None or not len(result.outside) else float(result.outside.mean())
        self.tracks.add(result.name, result.status, result.estimate.notes, outside)

    def print(self, observe: float) -> None:
        """Prints the counts of tracks by status and the errors of their predictions."""
        self.tracks.print()
        if self.rows:
            rmse = 1e3 * (self.squares / self.rows) ** 0.5
            print(f"  RMSE against what was measured there: {rmse:.1f} mm over all stamps")
        if self.ended:
            print(f"  {self.ended} of the tracks end within {observe:g} s: nothing to predict")
