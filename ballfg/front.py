"""The front door estimates, predicts and diagnoses from arrays, tracks, datasets and folders alike."""

from collections.abc import Callable, Iterator
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, TypedDict, Unpack, cast, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ballfg.checks import check_count, check_path, shown, type_name
from ballfg.dynamics.compiled.kept_model import check_model, ready_file, whole
from ballfg.dynamics.nominal import inertia_factor, ready_nominal
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation import Estimate, Estimator, Settings
from ballfg.estimation.registry import make_estimator
from ballfg.machine import MOST_JOBS
from ballfg.prediction import BallState, Forecast
from ballfg.tracks import TABLE_TENNIS, Ball, Dataset, Track
from ballfg.tracks.info import TrackFolder

if TYPE_CHECKING:
    from ballfg.diagnosis import Diagnosis
    from ballfg.diagnosis.budget import ErrorBudget
    from ballfg.dynamics import BallModel
    from ballfg.estimation import ConformalScales, TrackGraph
    from ballfg.estimation.flights.dataset import InFlight
    from ballfg.estimation.observations.sighted_dataset import SightedDataset
    from ballfg.estimation.track_prediction import TrackPrediction

Folder: TypeAlias = str | PathLike[str]
Tracks: TypeAlias = "Dataset | SightedDataset"
Model: TypeAlias = "BallModel | Ball | Folder | None"
Conformal: TypeAlias = "Tracks | ConformalScales | Folder | None"
OneTrack: TypeAlias = Track | NDArray[np.float64] | tuple[ArrayLike, ArrayLike]
"""A track; or an array (n, 4) of t (s), x, y, z (m); or times (n,) s and positions (n, 3) m."""


class Options(TypedDict, total=False):
    """The keyword arguments of `estimate`."""

    method: str
    model: Model
    surfaces: Surfaces | float | None
    settings: Settings | None
    jobs: int


class PredictOptions(Options, total=False):
    """The keyword arguments of `predict`; observe in s."""

    observe: float
    conformal: Conformal


@overload
def estimate(measured: OneTrack, **options: Unpack[Options]) -> Estimate: ...
@overload
def estimate(measured: "Tracks | Folder", **options: Unpack[Options]) -> dict[str, Estimate]: ...
def estimate(
    measured: "OneTrack | Tracks | Folder",
    *,
    method: str = "smoother",
    model: Model = None,
    surfaces: Surfaces | float | None = None,
    settings: Settings | None = None,
    jobs: int = 1,
) -> Estimate | dict[str, Estimate]:
    """Position, velocity and spin of the ball at every stamp, with covariances.

    By default, ball, table and noise are those of a track's dataset. A track without a dataset counts as a table-tennis
    ball above a table at z = 0, and the scatter of its flights about smooth paths as their noise; the notes of its
    estimate list signs against that.

    Args:
        measured: a track or its arrays, (n, 4) of t, x, y, z in s and m or times (n,) s and positions (n, 3) m; or a
            dataset or its folder for all tracks.
        method: "smoother", "online", "ekf", "sliding-window", or the name of a registered estimator.
        model: of the ball, or its file; None: the nominal model of the ball; of a `Ball`, its nominal model.
        surfaces: table and floor; a number is the height of the table, m.
        settings: noise and priors; None: those of measured tracks.
        jobs: processes for a dataset.
    Returns: the estimate of a track; of a dataset, the estimates of all its tracks by name.
    Raises:
        TypeError: for anything else in place of a track.
        ValueError: an unknown method, or numbers that cannot be metres and seconds.
        FileNotFoundError: a folder or model file that is not there.
    """
    check_count("jobs", jobs, 1, MOST_JOBS)
    data = _opened(measured)
    estimator = estimator_for(data, method, model, surfaces, settings)
    if isinstance(data, Track):
        from ballfg.estimation.flights.estimates import Seen

        seen = Seen.of(estimator, data)
        return seen.labelled(estimator.estimate(data)) if seen.whole else seen.estimated(estimator)
    from ballfg.estimation.batch import estimate_tracks

    return {one.name: one for one in estimate_tracks(estimator, data, len(data), jobs, flights=True)}


@overload
def flights(measured: OneTrack, *, model: Model = ...) -> list[Track]: ...
@overload
def flights(measured: Dataset | Folder, *, model: Model = ...) -> Dataset: ...
def flights(measured: OneTrack | Dataset | Folder, *, model: Model = None) -> list[Track] | Dataset:
    """The flights in recordings: where a ball flies, bounces or is struck, and is not held, rolls or rests.

    A track that only flies is returned as it is. The labels `begins` and `ends` of the others say why a flight begins
    and ends, `recording` names the track (docs/import.md).

    Args:
        measured: a track or its arrays, as for `estimate`; or a dataset of positions or its folder.
        model: of the ball, for one track; as for `estimate`.
    Returns: the flights of a track; of a dataset, a dataset of all flights.
    Raises:
        TypeError: for anything else in place of a track or a dataset of positions.
        ValueError: a track or folder that breaks a rule.
        FileNotFoundError: a folder or model file that is not there.
    """
    data = _opened(measured)
    if isinstance(data, Track):
        from ballfg.estimation.flights.dataset import flights_of
        from ballfg.estimation.segmentation.physics import physics_of

        return flights_of(data, physics_of(_model(model, data.dataset)))
    return _in_flight(_table_of_positions(data)).dataset


@overload
def predict(
    known: Estimate | BallState | OneTrack, horizon: float = ..., **options: Unpack[PredictOptions]
) -> Forecast: ...
@overload
def predict(
    known: "Tracks | Folder", horizon: float = ..., **options: Unpack[PredictOptions]
) -> "dict[str, TrackPrediction]": ...
def predict(
    known: "Estimate | BallState | OneTrack | Tracks | Folder",
    horizon: float = 0.3,
    *,
    observe: float = 0.25,
    method: str = "smoother",
    model: Model = None,
    surfaces: Surfaces | float | None = None,
    settings: Settings | None = None,
    conformal: Conformal = None,
    jobs: int = 1,
) -> "Forecast | dict[str, TrackPrediction]":
    """The path of the ball ahead, with standard deviations.

    Args:
        known: an estimate or a state; a track or its arrays, estimated first; a dataset or its folder: the first
            `observe` seconds of each track are estimated, and the measurements after them are predicted.
        horizon: s, how far ahead.
        observe: s from the first stamp of each track of a dataset.
        conformal: for a dataset: calibration tracks of the same kind or their folder, the scales of an earlier
            prediction, or their file. The sigmas are scaled so that mean +- 1.645 sigma are conformal 90 % intervals
            (docs/predict.md); `conformal` of each prediction has the scales and the coverage on the calibration tracks.
        method, model, surfaces, settings, jobs: as for `estimate`, also for the calibration tracks.
    Returns: the path ahead; of a dataset, the predicted measurements of each track by name.
    Raises:
        TypeError: for `known` or calibration tracks of another type.
        ValueError: a horizon that is not positive, too few calibration tracks or tracks of another kind, or as from
            `estimate`.
    """
    check_count("jobs", jobs, 1, MOST_JOBS)
    if isinstance(known, Estimate | BallState):
        _refuse(conformal)
        return known.predict(horizon)
    data = _opened(known)
    if isinstance(data, Track):
        _refuse(conformal)
        from ballfg.estimation.flights.estimates import estimated

        return estimated(estimator_for(data, method, model, surfaces, settings), data).predict(horizon)
    from ballfg.estimation import predict_tracks
    from ballfg.estimation.track_prediction import check_observe

    check_observe(observe)
    observe = float(observe)
    data = _in_flight(data, jobs).dataset if isinstance(data, Dataset) else data
    estimator = estimator_for(data, method, model, surfaces, settings, observe)
    predicted = partial(predict_tracks, estimator, observe=observe, horizon=horizon, jobs=jobs)
    scales = _scales(conformal, data, predicted, method, observe)
    found = predicted(data, len(data))
    return {one.name: one if scales is None else scales.scaled(one) for one in found}


def _in_flight(data: Dataset, jobs: int = 1) -> "InFlight":
    """The flights of a dataset, and how much of it they are."""
    from ballfg.estimation.flights.dataset import in_flight as found_in
    from ballfg.parallel.parts import using

    with using(jobs):
        return found_in(data)


def _refuse(conformal: Conformal) -> None:
    if conformal is not None:
        raise ValueError(
            f"conformal must be None for a single ball; got {type(conformal).__name__}. Its scales hold at the stamps "
            "of a dataset's tracks: predict a dataset."
        )


def _scales(
    conformal: Conformal,
    data: Tracks,
    predicted: "Callable[[Tracks, int], Iterator[TrackPrediction]]",
    method: str,
    observe: float,
) -> "ConformalScales | None":
    """The scales of predictions of `data`: the given ones, or from the given calibration tracks."""
    from ballfg.estimation import ConformalScales
    from ballfg.estimation.conformal import check_calibration_tracks, load_conformal

    if isinstance(conformal, str | PathLike) and check_path("conformal", conformal).is_file():
        conformal = load_conformal(Path(conformal))
    if isinstance(conformal, ConformalScales):
        conformal.check_fits(observe, method)
    if conformal is None or isinstance(conformal, ConformalScales):
        return conformal
    calibration = _opened(conformal)
    if isinstance(calibration, Track):
        raise TypeError("conformal must be a dataset of calibration tracks or its folder; got a track. Give a dataset.")
    calibration = _in_flight(calibration).dataset if isinstance(calibration, Dataset) else calibration
    check_calibration_tracks(calibration, data)
    return ConformalScales.of(predicted(calibration, len(calibration)), calibration.info.name, observe, method)


def diagnose(measured: "Tracks | Folder", model: Model = None, *, jobs: int = 1) -> "Diagnosis":
    """The effects that the model of the ball lacks, found in measured tracks, or in strokes that one camera saw.

    Args:
        measured: a dataset or its folder; one half of the tracks finds effects, the other half judges them. Strokes of
            one camera, which have no table of positions, are searched as a whole.
        model: the analytic model to diagnose, or its file; None: the nominal model of the ball; of a `Ball`, likewise.
        jobs: processes.
    Returns: the effects found, with their evidence, and the corrected model.
    Raises:
        TypeError: for another type in place of a dataset, or a model that is learned or no model.
        ValueError: detections of several cameras, too few tracks, or none with a flight that is long enough.
        FileNotFoundError: a folder or model file that is not there.
    """
    check_count("jobs", jobs, 1, MOST_JOBS)
    from ballfg.diagnosis import diagnose as diagnose_dataset  # half of the package, which estimates do not need
    from ballfg.estimation.observations.sighted_dataset import SightedDataset
    from ballfg.parallel.work import on_one_thread

    data = _opened(measured) if isinstance(measured, str | PathLike) else measured
    if isinstance(data, SightedDataset):
        from ballfg.diagnosis.one_view.diagnosis import diagnose_one_view

        return on_one_thread(partial(diagnose_one_view, data, jobs=jobs), whole(_model(model, data)))
    data = _table_of_positions(data)
    # as in the commands: threads gain nothing on such small batches, and slow each other down
    flights_alone = _in_flight(data, jobs).dataset
    return on_one_thread(partial(diagnose_dataset, flights_alone, jobs=jobs), whole(_model(model, data)))


def error_budget(measured: Dataset | Folder, model: Model = None, *, jobs: int = 1) -> "ErrorBudget":
    """The parts of the prediction error of a dataset: noise, spins, coefficients, bounces, open motion, the rest.

    No effect is searched: the budget is that of the model as it is, with its coefficients and noise fitted to one half
    of the tracks. `diagnose` gives the budget with the effects that it finds as `budget`.

    Args: measured, model, jobs: as for `diagnose`.
    Returns: the parts in mm; their squares add up to that of the measured error (docs/diagnose.md).
    Raises:
        TypeError: as `diagnose`.
        ValueError: as `diagnose`, or if the model sees a hit in each predicted track.
        FileNotFoundError: as `diagnose`.
    """
    check_count("jobs", jobs, 1, MOST_JOBS)
    data = _table_of_positions(measured)
    from ballfg.diagnosis.error_budget import error_budget as budget_of_dataset
    from ballfg.parallel.work import on_one_thread

    flights_alone = _in_flight(data, jobs).dataset
    return on_one_thread(partial(budget_of_dataset, flights_alone, jobs=jobs), whole(_model(model, data)))


def _table_of_positions(measured: object) -> Dataset:
    """A dataset with a table of positions, or its folder, opened; errors as of `diagnose`."""
    from ballfg.estimation.observations.sighted_dataset import SightedDataset

    data = _opened(measured) if isinstance(measured, str | PathLike) else measured
    if isinstance(data, SightedDataset):
        raise ValueError("measured must have a table of positions; got detections. Make tracks with 'ballfg track'.")
    if not isinstance(data, Dataset):
        what = "one Track; effects show in many of them" if isinstance(data, Track) else type_name(data)
        raise TypeError(
            f"measured must be a dataset or its folder; got {what}. Read one with bf.read, or make one of tracks with "
            "bf.import_tracks or ballfg.tracks.dataset.dataset_in_memory."
        )
    return data


def graph(
    measured: OneTrack,
    *,
    model: Model = None,
    surfaces: Surfaces | float | None = None,
    settings: Settings | None = None,
) -> "TrackGraph":
    """The factor graph of a track as GTSAM's objects, for GTSAM's solvers and for further factors.

    Args:
        measured: a track or its arrays, as for `estimate`.
        model, surfaces, settings: as for `estimate`.
    Returns: factors, values at the smoother's estimate, keys of the states; `Estimate.from_gtsam` leads back.
    Raises:
        TypeError: for anything else in place of a track.
        ValueError: a track without a graph or with more than a flight, a model with measurement effects, or as
            `estimate`.
    """
    track = _opened(measured)
    if not isinstance(track, Track):
        raise TypeError("measured must be one track; got a dataset. Choose a track of it by its name.")
    from ballfg.estimation import Smoother, TrackGraph
    from ballfg.estimation.flights.estimates import Seen

    found = estimator_for(track, "smoother", model, surfaces, settings).of(track)
    if not found.model.measures_plainly:
        raise ValueError(
            "model must have no measurement effects for a graph, whose factors hold true positions. Correct positions "
            "and stamps of the track, and leave the model's section measurement empty; or call bf.estimate, which "
            "undoes the effects, with GTSAM too (settings.solver)."
        )
    smoother = Smoother(found.model, found.surfaces, found.settings)
    if not Seen.of(smoother, track).whole:  # its graph would explain a ball in a hand by flight and hits
        raise ValueError(
            f"track {shown(track.name)} must be one flight; got a ball that is also held, rolls or rests. Take one of "
            "bf.flights(track)."
        )
    return TrackGraph.of(smoother, track)


def estimator_for(
    data: "Track | Tracks",
    method: str = "smoother",
    model: Model = None,
    surfaces: Surfaces | float | None = None,
    settings: Settings | None = None,
    observed: float = np.inf,
) -> Estimator:
    """The estimator that `estimate` uses; arguments and errors as there.

    Args: observed: s from the start of each track that a noise estimate may use.
    """
    source = data.dataset if isinstance(data, Track) else data
    ball = _model(model, source)
    if source is not None:
        from ballfg.estimation import dataset_surfaces
        from ballfg.estimation.configure import fitted_settings
    if surfaces is None:
        surfaces = 0.0 if source is None else dataset_surfaces(source)
    if settings is None and source is not None:
        settings = fitted_settings(source, ball, observed)
    elif settings is None:
        from ballfg.estimation.flights.estimates import with_shown_noise

        usual = make_estimator(method, ball, surfaces, Settings.for_measured(ball))
        settings = with_shown_noise(usual, cast(Track, data))
    return make_estimator(method, ball, surfaces, settings)


def _model(model: Model, source: "Tracks | None") -> "BallModel":
    ball = TABLE_TENNIS if source is None else source.ball
    if model is None or isinstance(model, Ball):
        return ready_nominal(ball if model is None else model)
    if not isinstance(model, str | PathLike):
        check_model(model, "Load one with load_model, or give its file.")
        return model
    room = None if source is None else source.info.name
    radius = None if source is None else ball.radius  # a track by itself is of the ball that a network knows
    return ready_file(Path(model), radius=radius, inertia_factor=inertia_factor(ball), room=room)


def _opened(measured: object) -> "Track | Tracks":
    if isinstance(measured, str | PathLike):
        from ballfg.estimation import read

        return read(measured)
    if isinstance(measured, Track | TrackFolder):
        return cast("Track | Tracks", measured)
    if isinstance(measured, np.ndarray) and measured.ndim == 2 and measured.shape[1] == 4:
        return Track(measured[:, 0], measured[:, 1:])
    if isinstance(measured, tuple) and len(measured) == 2:
        return Track(*measured)
    raise TypeError(
        f"measured must be a Track, a dataset, its folder, or arrays; got {type(measured).__name__}. Arrays are times "
        "(n,) s and positions (n, 3) m as a pair, or one array (n, 4) of both."
    )
