"""Chooses settings and surfaces for a dataset, from its statements of noise and table or else from its tracks."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from ballfg.checks import shown
from ballfg.dynamics.coefficient import DOUBT
from ballfg.dynamics.compiled.kept_model import KeptModel, content_of
from ballfg.dynamics.population import SpinPopulation
from ballfg.dynamics.surfaces import Surfaces
from ballfg.dynamics.trained import Trained
from ballfg.estimation.flights.dataset import in_flight
from ballfg.estimation.launcher import Launcher
from ballfg.estimation.measurement.position_noise import estimate_position_noise
from ballfg.estimation.noise.estimate import estimate_noise, spread_over
from ballfg.estimation.noise.parameters import with_noise
from ballfg.estimation.observations.sighted_dataset import SightedDataset
from ballfg.estimation.out_of_distribution import out_of_distribution, out_of_distribution_share
from ballfg.estimation.registry import make_estimator
from ballfg.estimation.settings import MEASURED, Settings
from ballfg.estimation.table_extent import TableExtent, find_table_extent
from ballfg.factors.noise import PROCESS_NOISE, ProcessNoise
from ballfg.parallel.parts import jobs_here
from ballfg.progress import Watch, doing, unwatched
from ballfg.state import STATE_DIM
from ballfg.tracks import Dataset, Track
from ballfg.tracks.info import DatasetInfo
from ballfg.tracks.noise import TrackNoise
from ballfg.tracks.track import level_of

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel

TRACKS_FOR_NOISE = 50  # Number of tracks for the estimate of the measurement noise when a dataset does not state it
KEPT = 8  # Number of datasets whose noise is cached: their tracks may be estimated one by one
LEAST_TRACKS = 5  # Least number of tracks that shows how much tracks differ
FEW_TRACKS = "too few tracks to show their noise: that of bounces and coefficients is the usual one"
STATED_EDGE_SIGMA = 0.01  # m, of a stated table end: a ball touches an edge up to its radius beside it
TRACKS_FOR_TABLE = 200
"""Number of tracks for the table's ends. Few balls miss the table; 200 tracks hold some of them and take 0.1 s."""


def dataset_settings(dataset: Dataset | SightedDataset, model: BallModel) -> Settings:
    """Settings for measured tracks; tracks from cameras have the noise of each sighting.

    The position noise is the dataset's; if it states none, the scatter of the first tracks about short polynomials
    gives it. The coefficients of an analytic model are estimated with each track, within their priors; a trained model
    is fixed, with its learned noise and launcher. In a room outside of the training, by the name of the dataset, the
    coefficients of the corrected model are estimated again, and the noise of motion and bounces is that of the tracks
    about them. Other noise that the model or, second, the dataset states takes precedence. The model's groups of shots
    give the spin of tracks without a spin label.
    """
    stated = dataset.info.noise
    if stated is not None and stated.coefficients:
        from ballfg.dynamics.model_file import check_spreads

        check_spreads(stated, model, f"dataset.yaml of {shown(dataset.info.name)}: ")
    return _settings(dataset, model, (stated, _own_noise(dataset, model)))


def usual_settings(dataset: Dataset | SightedDataset, model: BallModel) -> Settings:
    """`dataset_settings` without the noise that `dataset.yaml` and the model state: the prior of what tracks show.

    Stated noise may come from the same tracks, which a prior with it would count twice.
    """
    return _settings(dataset, model, ())


def _settings(dataset: Dataset | SightedDataset, model: BallModel, noises: Sequence[TrackNoise | None]) -> Settings:
    """The settings with stated noises, of which a later one takes precedence."""
    info, trained = dataset.info, model.trained
    if info.position_noise is not None:
        noise = (info.position_noise,) * 3
    elif dataset.rough:
        noise = Settings().position_noise
    else:
        noise = _noise_of(dataset)
    if trained is None:
        settings = Settings.for_measured(model, position_noise=noise, spins=None)
    elif trained.elsewhere is not None and trained.is_foreign(info.name):
        settings = Settings.for_measured(model, position_noise=noise, launcher=launcher_of(info, model), spins=None)
        settings = with_noise(settings, trained.elsewhere)
    else:
        settings = Settings(
            position_noise=noise,
            position_scale=trained.position_scale,
            process=learned_process(trained),
            launcher=launcher_of(info, model),
        )
        if trained.launcher is None and trained.spin_noise is not None:
            settings = replace(settings, spin_label_noise=trained.spin_noise)
    if info.spin_noise is not None:
        settings = replace(settings, spin_label_noise=info.spin_noise)
    for stated in noises:
        settings = settings if stated is None else with_noise(settings, stated)
    if dataset.one_view:  # predictions have one process noise for all tracks
        settings = replace(settings, process=settings.for_track(next(iter(dataset))).process)
    return settings if model.spins is None else _grouped(settings, dataset, model.spins)


def _grouped(settings: Settings, dataset: Dataset | SightedDataset, spins: SpinPopulation) -> Settings:
    """The settings with a model's groups; tracks without the label are the dataset's own group, as in training."""
    own = level_of(dataset.info.name, spins.groups)
    if own is None and spins.by not in dataset.label_names:
        spins = spins.with_unseen(settings.spin_prior)
    return replace(settings, spins=spins, group=own)


def _own_noise(dataset: Dataset | SightedDataset, model: BallModel) -> TrackNoise | None:
    """The noise that a model file states; None for a network in another room, where its `Trained.elsewhere` counts."""
    return None if model.trained is not None and model.trained.is_foreign(dataset.info.name) else model.noise


def fitted_settings(
    dataset: Dataset | SightedDataset, model: BallModel, observed: float = np.inf, watch: Watch = unwatched
) -> Settings:
    """`dataset_settings`, with the noise estimated from the tracks if neither dataset nor model states it.

    Args:
        dataset: `estimate_noise` sees a few of its tracks. The settings are those of `dataset_settings` with fewer than
            `LEAST_TRACKS` tracks, with sightings of cameras, or with a trained model in its own rooms.
        model: the ball.  observed: s, the part of each track that the estimate may use.
        watch: called for each track and each step of the search.
    """
    if isinstance(dataset, Dataset):
        dataset = in_flight(dataset, TRACKS_FOR_TABLE).dataset
    settings = dataset_settings(dataset, model)
    if _noise_is_stated(dataset, model) or dataset.rough or len(dataset) < LEAST_TRACKS:
        return settings
    key = (dataset, _content(model), observed)
    if key not in _FITTED:
        while len(_FITTED) >= KEPT:
            del _FITTED[next(iter(_FITTED))]
        with doing("looking for the noise that the tracks show"):
            _FITTED[key] = _fitted(dataset, model, observed, watch)
    return _FITTED[key] or settings


def _noise_is_stated(dataset: Dataset | SightedDataset, model: BallModel) -> bool:
    at_home = model.trained is not None and not model.trained.is_foreign(dataset.info.name)
    own = _own_noise(dataset, model)
    # spreads of coefficients alone, as of several sets, are a prior: the tracks show the rest
    return dataset.info.noise is not None or (own is not None and own.states_more_than_spreads) or at_home


def usual_noise(dataset: Dataset | SightedDataset, model: BallModel) -> tuple[str, ...]:
    """A sentence where tracks are too few to show their noise, unless `dataset.yaml` has it."""
    known = dataset.rough or _noise_is_stated(dataset, model) or FEW_TRACKS in dataset.info.doubts
    return () if known or len(dataset) >= LEAST_TRACKS else (FEW_TRACKS,)


_FITTED: dict[tuple[Dataset | SightedDataset, Hashable, float], Settings | None] = {}


def _content(model: BallModel) -> Hashable:
    """Equal for analytic models with equal content, which every call of the front door makes or loads anew."""
    if type(model) is KeptModel and (content := model.content) is not None:
        stated = repr((model.radius, model.inertia_factor, content, model.declared_coefficients()))
        return stated, tuple(part.source for part in model.functions.parts)
    from ballfg.dynamics.analytic import AnalyticModel

    values = tuple(p.detach().numpy().tobytes() for p in model.parameters())
    if not isinstance(model, AnalyticModel) or model.trained is not None:
        return model, values
    parts = tuple(type(module) for module in model.modules())
    stated = repr((model.radius, model.inertia_factor, content_of(model), model.declared_coefficients()))
    return parts, stated, values


def _fitted(dataset: Dataset | SightedDataset, model: BallModel, observed: float, watch: Watch) -> Settings | None:
    """The settings with the noise estimated from the tracks; None if the tracks do not determine it."""
    chosen = spread_over(dataset, min(len(dataset), TRACKS_FOR_TABLE))
    parts = [track.opening(observed) for track in chosen]
    surfaces, before = dataset_surfaces(dataset), dataset_settings(dataset, model)
    known = dataset.info.position_noise is not None
    return tracks_settings(model, surfaces, before, parts, known, watch)


def tracks_settings(
    model: BallModel, surfaces: Surfaces, settings: Settings, parts: Sequence[Track], position_known: bool, watch: Watch
) -> Settings | None:
    """The settings with the noise estimated from parts of tracks; None if they do not determine it.

    The first parts of tracks give too large an acceleration noise. A network has learned it from whole tracks similar
    to these: the noise is the geometric mean of both, weighted with the share of flights inside of its training data.
    The same share weights other noise between its usual values and those of the training. Outside of the training data
    the network's correction is missing; bounces are widened by the usual size of it.

    Args:
        settings: prior ones; for a trained model, with the noise of its training.
        position_known: True if the white noise of positions is stated.  watch: as for `fitted_settings`.
    """
    doubts = {name: sigma for name, sigma in settings.coefficients.items() if name.startswith(DOUBT)}
    plain = replace(settings, coefficients={n: s for n, s in settings.coefficients.items() if n not in doubts})
    outside = _share_outside(model, surfaces, plain, parts)
    begun = plain if outside is None else with_usual_noise(plain, model, outside)
    jobs = jobs_here()
    found = estimate_noise(
        model, surfaces, begun, parts, position_known=position_known, errors=False, watch=watch, jobs=jobs
    )
    if found is None or outside is None:
        return None if found is None else found.settings
    known, shown = settings.process.acceleration, found.settings.process.acceleration
    acceleration = _between(known, shown, outside)
    process = widened(replace(found.settings.process, acceleration=acceleration), model, outside)
    return replace(found.settings, process=process, coefficients={**found.settings.coefficients, **doubts})


def _share_outside(model: BallModel, surfaces: Surfaces, settings: Settings, parts: Sequence[Track]) -> float | None:
    """Share of the flights outside of a network's training data; None without such data."""
    if out_of_distribution(model, np.zeros((1, STATE_DIM))) is None:
        return None
    smoother = make_estimator("smoother", model, surfaces, settings)  # it undoes what the model says of measurement
    return out_of_distribution_share(model, [smoother.estimate(part).states for part in parts])


def widened(process: ProcessNoise, model: BallModel, outside: float) -> ProcessNoise:
    """Process noise plus the network's usual correction, weighted with the share of flights outside of its training."""
    from ballfg.dynamics.networks.learned import LearnedModel

    if not isinstance(model, LearnedModel) or model.fading is None:
        return process
    kick = outside * float(model.fading.velocity) / np.sqrt(3.0)
    return replace(process, contact_velocity=float(np.hypot(process.contact_velocity, kick)))


def with_usual_noise(settings: Settings, model: BallModel, share: float) -> Settings:
    """Settings whose noise, except for positions, moves to a model's usual one by a share from 0 to 1."""
    usual = Settings.for_measured(model, spins=None)
    spreads = {name: _between(s, usual.coefficients.get(name, s), share) for name, s in settings.coefficients.items()}
    own = settings.process
    noise = {name: _between(getattr(own, name), getattr(MEASURED, name), share) for name in PROCESS_NOISE}
    spin = _between(settings.spin_prior, usual.spin_prior, share)
    return replace(settings, process=replace(own, **noise), spin_prior=spin, coefficients=spreads)


def _between(one: float, other: float, share: float) -> float:
    """From one number (share 0) to another (share 1) on a logarithmic scale; both not negative."""
    return float(one ** (1.0 - share) * other**share)


@lru_cache(maxsize=8)
def _noise_of(dataset: Dataset | SightedDataset) -> tuple[float, float, float]:
    """m, along x, y, z, from the first tracks; cached, since a dataset's tracks may be estimated one by one."""
    x, y, z = estimate_position_noise(islice(iter(dataset), TRACKS_FOR_NOISE)).tolist()
    return x, y, z


def learned_process(trained: Trained) -> ProcessNoise:
    """The learned process noise, with usual values for the rest. Raises: ValueError: a number of another name."""
    unknown = sorted(set(trained.process_noise) - set(PROCESS_NOISE))
    if unknown:
        known = ", ".join(PROCESS_NOISE)
        raise ValueError(
            f"process_noise must name numbers of the process noise, {known}; got '{unknown[0]}'. Rename it."
        )
    return replace(MEASURED, **trained.process_noise)


def launcher_of(info: DatasetInfo, model: BallModel) -> Launcher | None:
    """The trained launcher for a dataset; a track without the label `group` belongs to the dataset's own group."""
    trained = model.trained
    if trained is None or trained.launcher is None or trained.spin_noise is None:
        return None
    return Launcher(trained.launcher, trained.spin_noise, {"group": info.name})


def dataset_surfaces(dataset: Dataset | SightedDataset) -> Surfaces:
    """The dataset's table and the floor below it, or no surface.

    The table's ends come from `dataset.yaml`, else from the sides past which balls fell.
    """
    info = dataset.info
    surfaces = Surfaces.table_tennis(dataset.table)
    if info.table_extent is not None:
        return replace(surfaces, extent=info.table_extent, edge_sigmas=(STATED_EDGE_SIGMA,) * 4)
    found = found_table(dataset)
    return surfaces if found is None else replace(surfaces, extent=found.sides, edge_sigmas=found.sigmas)


@lru_cache(maxsize=8)
def found_table(dataset: Dataset | SightedDataset) -> TableExtent | None:
    """The table's ends from the first tracks, whatever `dataset.yaml` says; None if the tracks do not show them."""
    if dataset.info.table_height is None:
        return None
    tracks = islice(iter(dataset), TRACKS_FOR_TABLE)
    return find_table_extent(tracks, dataset.info.table_height, dataset.ball.radius)


def table_note(dataset: Dataset | SightedDataset) -> str | None:
    """A sentence on the table's ends that were found from the tracks; None without any."""
    found = found_table(dataset) if dataset.info.table_extent is None else None
    return None if found is None else str(found)
