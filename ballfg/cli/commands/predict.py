"""Implements `ballfg predict`, which predicts the later positions of every track from its first part."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ballfg.cli import inputs
from ballfg.cli.outcome import Outcome
from ballfg.progress import counted, print_doubts, print_notes, progress

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np

    from ballfg.estimation import ConformalScales, Estimator
    from ballfg.estimation.track_prediction import TrackPrediction
    from ballfg.prediction.plane import Plane
    from ballfg.tracks import Dataset, TableWriter

EVENTS_WITHIN, LONGEST, STEP = 3.0, 60.0, 0.005
"""s: range of the search for events, the largest one, and steps of the path that gives their probability."""
LEAST_HELD, LEAST_JUDGED = 0.8, 5
"""Share of what was measured that 90 % intervals hold, the mean over tracks, below which they are doubted; tracks."""


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
    horizon: Annotated[
        float | None,
        typer.Option(
            help="How far to predict after the observed part, s: also beyond the last stamp, in the track's usual "
            "steps. Of events, how far ahead they are looked for.",
            show_default="all stamps; events: 3",
        ),
    ] = None,
    plane: Annotated[
        list[str] | None,
        typer.Option(
            help="In place of positions, where and when the ball crosses a plane: x=2.0, or z=3.05,down, or "
            "z=0.9,up,after=1 (bounces before it), or 0.6:0:0.8=1.2 (any normal). May be repeated."
        ),
    ] = None,
    apex: Annotated[bool, typer.Option("--apex", help="The same of the next highest point.")] = False,
    next_contact: Annotated[bool, typer.Option("--next-contact", help="The same of the next bounce.")] = False,
    anyway: inputs.Anyway = False,
    jobs: inputs.Jobs = inputs.CORES,
    cluster: inputs.Cluster = None,
    address: inputs.Address = None,
) -> None:
    """Positions at every stamp after the observed part, with the standard deviation of a measurement there.

    These are the positions that will be measured: measurement effects of the model file are included. A network that
    knows where it was trained adds the column outside: 0 there, 1 far from it.

    From detections, they are the ball's positions, and the error stated at the end is the distance from the rough ones
    that all sightings give.

    With --plane, --apex or --next-contact the table has a row for each track and event: its probability within the
    horizon; and, where the expected ball has one, time, place, speed and their standard deviations.

    Where the observed part of a track could not be estimated, its prediction is wide; such tracks are listed, and the
    exit status is 3.

    Example: ballfg predict data/ballgun --observe 0.25 --out predictions.csv
    Example: ballfg predict throws --observe 0.4 --plane z=3.05,down --out hoop.csv
    """
    from ballfg.checks import check_number
    from ballfg.estimation import predict_tracks
    from ballfg.estimation.track_prediction import check_observe
    from ballfg.files.whole_file import check_file
    from ballfg.prediction.plane import APEX, CONTACT, asked_event
    from ballfg.tracks import TableWriter

    outcome = _Outcome()
    asked = {text: asked_event(text) for text in (*(plane or ()), *[APEX] * apex, *[CONTACT] * next_contact)}
    ahead = None if horizon is None else check_number("horizon", horizon, "s", above=0.0, limit=LONGEST)
    if asked and conformal is not None:
        raise ValueError("conformal must not be given with events: its scales are those of positions. Leave it out.")
    with TableWriter(out, name="out") as table, inputs.workers(cluster, address, jobs) as workers:
        check_observe(observe)
        if save_conformal is not None:
            check_file(save_conformal, "save_conformal")
            if conformal is None:
                raise ValueError("save_conformal must come with --conformal, whose scales it keeps. Add --conformal.")
        inputs.know(observations=observations_file)
        inputs.check_out(out, dataset)
        opened = inputs.open_source(source, dataset, model, effects_file, observe, ball).in_flight(anyway)
        count = len(opened.dataset)
        seen = f"{counted(count, 'track')}, from the first {observe:g} s of each by {method}"
        estimator = opened.estimator(method, solver, group)
        scales = None
        if conformal is not None:
            if opened.dataset.rough:
                what = "conformal must not be given with detections: its scales are those of positions"
                raise ValueError(f"{what}. Leave it out.")
            scales = _conformal_scales(conformal, opened.dataset, estimator, method, observe, workers)
        if asked:
            _write_events(table, estimator, opened.dataset, observe, asked, ahead or EVENTS_WITHIN, workers, outcome)
            print(f"{out}: {counted(outcome.rows, 'event')} of {seen}")
            outcome.tracks.print()
            outcome.tracks.end()
            return
        until = math.inf if ahead is None else ahead
        predictions = predict_tracks(
            estimator, opened.dataset, count, observe, horizon=until, beyond=True, jobs=workers
        )
        for plain in progress(predictions, count, "tracks predicted"):
            result = plain if scales is None else scales.scaled(plain)
            columns: dict[str, str | np.ndarray] = {"trajectory": result.name, "t": result.times}
            columns |= dict(zip(("x", "y", "z"), result.positions.T, strict=True))
            columns |= dict(zip(("sigma_x", "sigma_y", "sigma_z"), result.sigmas.T, strict=True))
            table.write(columns if result.outside is None else columns | {"outside": result.outside})
            outcome.add(result, plain.sigmas)
    if scales is None:
        print_doubts(outcome.contradicted(opened.dataset.rough))
    print(f"{out}: {counted(outcome.rows, 'position')} of {seen}")
    outcome.print(observe)
    outcome.tracks.print_outside()
    if scales is not None:
        _print_conformal(scales, outcome)
        if save_conformal is not None:
            scales.save(save_conformal)
            print(f"{save_conformal}: the scales, for --conformal")
    outcome.tracks.end()


def _write_events(
    table: "TableWriter",
    estimator: "Estimator",
    dataset: "Dataset",
    observe: float,
    asked: "Mapping[str, Plane | str]",
    horizon: float,
    workers: int,
    outcome: "_Outcome",
) -> None:
    """A row for each track and event, by its text."""
    import numpy as np

    from ballfg.estimation import Status
    from ballfg.estimation.batch import estimate_tracks
    from ballfg.prediction.event_ahead import event_numbers

    count = len(dataset)
    estimates = estimate_tracks(estimator, (track.opening(observe) for track in dataset), count, workers)
    for estimate in progress(estimates, count, "tracks predicted"):
        ahead = estimate.predict(horizon, STEP) if estimate.status is Status.OK else None
        for text, event in asked.items():
            found = None if ahead is None else ahead.event(event)
            numbers = {"probability": np.nan if found is None else found.probability}
            numbers |= event_numbers(None if found is None else found.crossing)
            columns: dict[str, str | np.ndarray] = {"trajectory": estimate.name, "event": text}
            table.write(columns | {name: np.array([value]) for name, value in numbers.items()})
            outcome.rows += 1
        outcome.tracks.add(estimate.name, estimate.status, estimate.notes, None)


def _conformal_scales(
    source: Path,
    dataset: "Dataset",
    estimator: "Estimator",
    method: str,
    observe: float,
    jobs: int,
) -> "ConformalScales":
    """Scales from the calibration tracks of a folder, or from a file of scales."""
    from ballfg.estimation import ConformalScales, predict_tracks
    from ballfg.estimation.conformal import check_calibration_tracks, load_conformal
    from ballfg.estimation.flights.dataset import in_flight
    from ballfg.estimation.reading import with_readings
    from ballfg.tracks import read_dataset

    if source.is_file():
        scales = load_conformal(source)
        scales.check_fits(observe, method)
        return scales
    calibration = in_flight(with_readings(read_dataset(source))).dataset
    check_calibration_tracks(calibration, dataset)
    print_notes(f"calibration tracks: {note}" for note in calibration.notes)
    count = len(calibration)
    predictions = predict_tracks(estimator, calibration, count, observe, jobs=jobs)
    watched = progress(predictions, count, "calibration tracks predicted")
    return ConformalScales.of(watched, calibration.info.name, observe, method)


def _print_conformal(scales: "ConformalScales", outcome: "_Outcome") -> None:
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
    if infinite := outcome.infinite:
        print_notes(
            [
                f"{infinite} of {3 * outcome.rows} sigmas are infinite: a finite 90 % interval needs {FEWEST} "
                f"calibration tracks with samples as far ahead; up to {BIN * len(scales.tracks):g} s there are so many"
            ]
        )


@dataclass
class _Outcome:
    rows: int = 0
    measured: int = 0
    squares: float = 0.0
    ended: int = 0
    held: int = 0
    held_by_own: int = 0
    finite: int = 0
    infinite: int = 0
    judged: int = 0
    shares: float = 0.0
    tracks: Outcome = field(default_factory=Outcome)

    def add(self, result: "TrackPrediction", own_sigmas: "np.ndarray") -> None:
        """Counts a track, with the coordinates inside their finite 90 % intervals."""
        import numpy as np

        from ballfg.estimation.conformal import HALF_WIDTH

        errors = np.abs(result.positions - result.measured)
        measured = np.isfinite(errors)  # else beyond the track's end
        finite = np.isfinite(result.sigmas) & measured
        self.rows += len(result.times)
        self.measured += int(measured.all(axis=1).sum())
        self.squares += float((errors[measured] ** 2).sum())
        self.ended += len(result.times) == 0
        self.finite += int(finite.sum())
        self.infinite += int(np.isinf(result.sigmas).sum())
        held = finite & (errors <= HALF_WIDTH * result.sigmas)
        self.held += int(held.sum())
        if finite.any():
            self.judged, self.shares = self.judged + 1, self.shares + held.sum() / finite.sum()
        self.held_by_own += int((finite & (errors <= HALF_WIDTH * own_sigmas)).sum())
        outside = None if result.outside is None or not len(result.outside) else float(result.outside.mean())
        self.tracks.add(result.name, result.status, result.estimate.notes, outside)

    def contradicted(self, rough: bool) -> tuple[str, ...]:
        """A sentence on intervals that hold clearly less of what was measured than they state, by their mean share.

        Args: rough: True for detections, which are judged by the positions that cameras together show.
        """
        if self.judged < LEAST_JUDGED or (mean := self.shares / self.judged) >= LEAST_HELD:
            return ()
        said = f"90 % intervals hold {100 * mean:.0f} % of what was measured there"
        remedy = "widen them with --conformal and calibration tracks of the same kind"
        return (f"{said}; {'check the cameras, or write positions (ballfg track) and ' if rough else ''}{remedy}",)

    def print(self, observe: float) -> None:
        """Prints the counts of tracks by status and the errors of their predictions."""
        self.tracks.print()
        if self.measured:
            rmse = 1e3 * (self.squares / self.measured) ** 0.5
            print(f"  RMSE against what was measured there: {rmse:.1f} mm over all stamps")
        if self.ended:
            print(f"  {self.ended} of the tracks end within {observe:g} s: nothing to predict")
