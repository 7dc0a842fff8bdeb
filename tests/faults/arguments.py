"""Calls of the Python interface, each with good arguments, and what a user may pass by mistake in place of one."""

from __future__ import annotations

import math
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

import ballfg as bf
from ballfg import dynamics, estimation, factors, simulation, tracks, vision
from ballfg.dynamics.known_balls import known_ball
from ballfg.estimation.launcher import Launcher
from ballfg.estimation.registry import make_estimator
from ballfg.factors.loss import Loss
from ballfg.prediction import Plane
from ballfg.prediction.state import World
from ballfg.simulation.launcher import SimulatedLauncher
from ballfg.tracks.dataset import dataset_in_memory
from ballfg.tracks.info import DatasetInfo
from ballfg.tracks.noise import TrackNoise
from ballfg.tracks.sightings import Sightings
from ballfg.vision.projection import CameraBank
from tests.places import ROOT

LONGEST_MESSAGE = 1000
"""Characters. An import that is undecided lists the columns of a source."""

HOSTILE: tuple[Any, ...] = (
    None, "x", "", b"x", math.nan, math.inf, -math.inf, -1, -1.0, 0, 0.0, 1e300, 1e-300, 10**400, True, 1j,
    [], [1, 2], [[1.0]], [None] * 3, (1, 2, 3, 4), ("a", "b", "c"), {}, {"x": 1}, object(), int, lambda *_: 0,
    "a\0b", "\x1b[2J", "a\u202eb", "a" * 100_000, Path("a\0b"),
    Path("nonexistent/deep"), np.array([1.0, 2.0]), np.zeros((0, 3)), np.array(["a", "b", "c"]),
    np.datetime64("2024-01-01"), np.timedelta64(1, "s"), np.ma.masked_array([1.0, 2.0, 3.0], [True, False, False]),
)  # fmt: skip
"""Values of the wrong type, size or sort; some are right for some arguments."""


@dataclass(frozen=True)
class Call:
    """A function and arguments with which it works; those of a class are fields of an example where it is one."""

    function: Callable[..., Any]
    arguments: Mapping[str, Any]


@dataclass(frozen=True)
class Fault:
    """An argument for which the call did not end as it should."""

    argument: str
    value: str
    what: str

    def __str__(self) -> str:
        return f"{self.argument}={self.value}: {self.what}"


def faults_of(call: Call) -> Iterator[Fault]:
    """What goes wrong when one argument after the other has each hostile value; nothing is right."""
    for argument in call.arguments:
        for value in HOSTILE:
            what = _fault(call.function, {**call.arguments, argument: value})
            if what:
                yield Fault(argument, repr(value)[:40], what)


def _fault(function: Callable[..., Any], arguments: Mapping[str, Any]) -> str:
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        try:
            function(**arguments)
        except (TypeError, ValueError, OSError) as error:
            message, frame = str(error), traceback.extract_tb(error.__traceback__)[-1]
            own = (frame.line or "").startswith("raise") and "site-packages" not in Path(frame.filename).parts
            own = own and Path(frame.filename).is_relative_to(ROOT)
            if not own or "\n" in message or len(message) > LONGEST_MESSAGE:
                return f"{type(error).__name__}: {message[:200]!r} at {frame.filename}:{frame.lineno}"
        except Exception as error:  # the very thing that is looked for
            return f"{type(error).__name__}: {str(error)[:200]!r}"
    return "; ".join({f"{one.category.__name__}: {one.message}" for one in seen})


def _example(value: Any) -> dict[str, Any]:
    return {field.name: getattr(value, field.name) for field in fields(value) if field.init}


def _tracks(count: int, samples: int = 12) -> list[bf.Track]:
    config = simulation.SimulationConfig(tracks=count, rate=100.0, seed=3)
    return [shot.track.until(float(shot.track.times[samples - 1])) for shot in bf.simulate(config)]


def calls_of_tracks(folder: Path) -> dict[str, Call]:
    one, two = _tracks(2)
    radar, info = bf.RadarSpeed(0, 5.0, 0.1), DatasetInfo("a", 0.76, bf.Ball(0.02, 0.0027))
    sighted = Sightings(("a",), np.array([0]), np.array([0.0]), np.array([[1.0, 2.0]]), np.eye(2)[None])
    dataset = dataset_in_memory(info, [one, two])
    (longer,) = _tracks(1, 60)
    table = np.column_stack([longer.times, longer.positions])
    imported: dict[str, Any] = dict.fromkeys(
        ("out", "columns", "length", "time", "up", "flip", "split_gap", "ball", "rate", "key", "topic", "name")
    )
    return {
        "Track": Call(bf.Track, {**_example(replace(one, sigmas=np.full_like(one.positions, 0.003))), "labels": {}}),
        "Track.between": Call(one.between, {"start": 0.0, "end": 0.1}),
        "Track.observed": Call(lambda observation: one.observed(observation), {"observation": radar}),
        "RadarSpeed": Call(bf.RadarSpeed, {"state": [0], "values": [5.0], "sigma": 0.1, "delay": [0.0]}),
        "SpinReading": Call(bf.SpinReading, {"state": [0], "values": [[5.0, 1.0, 2.0]], "sigma": 0.1, "delay": [0.0]}),
        "RadarSpeed.at": Call(bf.RadarSpeed.at, {"track": one, "times": [0.1], "values": [5.0], "sigma": 0.1}),
        "Sightings": Call(Sightings, _example(sighted)),
        "DatasetInfo": Call(DatasetInfo, _example(info)),
        "TrackNoise": Call(TrackNoise, _example(TrackNoise())),
        "Dataset.track": Call(dataset.track, {"name": one.name}),
        "dataset_in_memory": Call(dataset_in_memory, {"info": info, "tracks": [one, two], "notes": ()}),
        "write_dataset": Call(tracks.write_dataset, {"folder": folder / "set", "info": info, "tracks": [one, two]}),
        "read": Call(bf.read, {"folder": folder / "set"}),
        "import_tracks": Call(
            bf.import_tracks,
            {**imported, "data": table, "table_height": 0.76, "file_format": "csv", "force": False, "flights": False},
        ),
    }


def calls_of_estimates(_folder: Path) -> dict[str, Call]:
    (track,), model = _tracks(1), bf.nominal_model()
    settings, table = bf.Settings.for_measured(model), bf.Surfaces.table_tennis(0.76)
    info = DatasetInfo("a", 0.76, bf.Ball(0.02, 0.0027))
    dataset = dataset_in_memory(info, [track])
    options = {"method": "sliding-window", "model": None, "surfaces": 0.76, "settings": settings, "jobs": 1}
    ahead = {"horizon": 0.05, "observe": 0.05, "conformal": None}
    found = bf.estimate(track, method="ekf", surfaces=0.76)
    parts = {"model": model, "surfaces": 0.76, "settings": settings}

    def push(**arguments: Any) -> object:
        stream = bf.Online(model, table, settings)
        for time, position in zip(track.times[:3], track.positions[:3], strict=True):
            stream.push(time, position)
        return stream.push(**{"time": 0.03, "position": track.positions[3], "sigma": None, **arguments})

    def arrays(times: Any, positions: Any) -> object:
        return bf.estimate((times, positions), method="sliding-window")

    return {
        "flights": Call(bf.flights, {"measured": track, "model": None}),
        "estimate": Call(bf.estimate, {"measured": track, **options}),
        "estimate of arrays": Call(arrays, {"times": track.times, "positions": track.positions}),
        "estimate of a dataset": Call(bf.estimate, {"measured": dataset, **options}),
        "graph": Call(bf.graph, {"measured": track, **dict.fromkeys(("model", "settings")), "surfaces": 0.76}),
        "predict": Call(bf.predict, {"known": track, **options, "horizon": 0.05, "conformal": None}),
        "predict of a dataset": Call(bf.predict, {"known": dataset, **options, **ahead}),
        "diagnose": Call(bf.diagnose, {"measured": "/nonexistent", "model": None, "jobs": 1}),
        "error_budget": Call(bf.error_budget, {"measured": "/nonexistent", "model": None, "jobs": 1}),
        "Estimate.predict": Call(found.predict, {"horizon": 0.05, "step": 0.01}),
        "Forecast.crossing": Call(found.predict(0.3).crossing, {"x": 1.0, "direction": "up", "after": 1}),
        "Forecast.event": Call(found.predict(0.3).event, {"asked": "apex"}),
        "Plane": Call(Plane, {"normal": (0.0, 0.0, 1.0), "offset": 0.9, "direction": "down", "after": 1}),
        "Settings": Call(bf.Settings, _example(settings)),
        "Smoother": Call(bf.Smoother, {**parts, "optimizer": None}),
        "ExtendedKalmanFilter": Call(bf.ExtendedKalmanFilter, {**parts, "smooth": False, "initialise": "prior"}),
        "SlidingWindow": Call(estimation.SlidingWindow, parts),
        "Online": Call(bf.Online, {**parts, "lag": 128, "cameras": (), "solver": None}),
        "Online.push": Call(
            push, {"time": 0.03, "position": track.positions[3], "sigma": [0.003] * 3, "observations": ()}
        ),
        "Smoother.estimate": Call(bf.Smoother(**parts).estimate, {"track": track, "factors": ()}),
        "make_estimator": Call(make_estimator, {"name": "ekf", **parts}),
        "estimate_noise": Call(
            estimation.estimate_noise, {**parts, "surfaces": table, "tracks": [track], "errors": False, "jobs": 1}
        ),
        "Launcher": Call(Launcher, {"embedding": None, "sigma": 1.0, "defaults": {}}),
        "Tracker": Call(bf.Tracker, {**parts, "lag": 0.1, "gap": 0.5, "confirm": 3, "most": 16}),
        "Tracker.push": Call(
            lambda **given: bf.Tracker(model, 0.76).push(**given),
            {"time": 0.0, "positions": track.positions[:1], "sigmas": None},
        ),
        "Loss": Call(Loss, {"name": "huber", "scale": 3.0}),
        "ProcessNoise": Call(factors.ProcessNoise, _example(factors.ProcessNoise())),
        "LevenbergMarquardt": Call(factors.LevenbergMarquardt, _example(factors.LevenbergMarquardt())),
        "register_estimator": Call(bf.register_estimator, {"cls": int}),
        "register_observation": Call(bf.register_observation, {"cls": int}),
    }


def calls_of_models(folder: Path) -> dict[str, Call]:
    model = bf.nominal_model()
    surfaces = {"table_height": 0.76, "floor_height": 0.0, "extent": (0.0, 1.0, 0.0, 1.0), "edge_sigmas": (0.0,) * 4}
    size = {"radius": 0.02, "inertia_factor": 0.6}
    return {
        "Surfaces": Call(bf.Surfaces, surfaces),
        "Ball": Call(bf.Ball, {"radius": 0.02, "mass": 0.0027}),
        "nominal_model": Call(bf.nominal_model, {"ball": 0.02}),
        "known_ball": Call(known_ball, {"name": "tennis"}),
        "AnalyticModel": Call(bf.AnalyticModel, {"effects": (), **size}),
        "drag": Call(dynamics.EFFECTS["drag"], {"k": 0.1}),
        "load_model": Call(bf.load_model, {"path": "/nonexistent", **size, "room": None}),
        "save_model": Call(bf.save_model, {"model": model, "path": folder / "model.yaml"}),
        "World": Call(World, {"model": model, "surfaces": bf.Surfaces(), "process": factors.ProcessNoise()}),
        "register": Call(bf.register, {"cls": int}),
    }


def calls_of_simulation(_folder: Path) -> dict[str, Call]:
    examples: tuple[Any, ...] = (
        simulation.SimulationConfig(),
        simulation.MeasurementNoise(),
        simulation.MotionNoise(),
        simulation.SceneConfig(),
        simulation.Clock(),
        SimulatedLauncher(),
        simulation.table_tennis(),
    )
    called = {type(example).__name__: Call(type(example), _example(example)) for example in examples}
    return {"simulate": Call(bf.simulate, {"config": simulation.SimulationConfig(tracks=1)}), **called}


def calls_of_cameras(_folder: Path) -> dict[str, Call]:
    matrix = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
    one = vision.Camera("a", (640, 480), matrix, np.zeros(5), np.zeros(3), np.zeros(3))
    two = replace(one, name="b", tvec=np.array([1.0, 0.0, 0.0]))
    pixels, covariances = np.array([[[320.0, 240.0], [300.0, 240.0]]]), np.tile(np.eye(2), (1, 2, 1, 1))
    stream = bf.Online(bf.nominal_model(), 0.76, cameras=[one])
    sighting = {"time": 0.0, "camera": "a", "pixel": [320.0, 240.0], "covariance": np.eye(2)}
    return {
        "Camera": Call(vision.Camera, _example(replace(one, covariance=np.eye(7)))),
        "CameraBank": Call(CameraBank, {"cameras": [one]}),
        "DetectorSettings": Call(vision.DetectorSettings, _example(vision.DetectorSettings())),
        "AssociationSettings": Call(vision.AssociationSettings, _example(vision.AssociationSettings())),
        "triangulate": Call(vision.triangulate, {"cameras": [one, two], "pixels": pixels, "covariances": covariances}),
        "Online.push_sighting": Call(lambda **given: (stream.reset(), stream.push_sighting(**given)), sighting),
    }


GROUPS: Mapping[str, Callable[[Path], dict[str, Call]]] = {
    "tracks": calls_of_tracks,
    "estimates": calls_of_estimates,
    "models": calls_of_models,
    "simulation": calls_of_simulation,
    "cameras": calls_of_cameras,
}
"""Makes the calls of a part of the interface by name; what they write goes to a folder."""
