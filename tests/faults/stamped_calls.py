"""What calls find in shots on a clock, as numbers by name."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

import ballfg as bf
from ballfg.estimation import estimate_noise, estimate_time_offsets
from ballfg.estimation.configure import dataset_settings, dataset_surfaces
from ballfg.live.tracker import Tracker
from ballfg.tracks.sightings import Sightings
from tests.estimation.observations.sighted_rig import RIG, scene, track_of, world
from tests.faults.stamped_commands import Numbers, flat
from tests.faults.stamped_shots import text


def of_states(states: list[Any]) -> dict[str, Any]:
    """Numbers of some `BallState`s."""
    return {
        "t": np.array([state.time for state in states]),
        "state": np.array([state.mean for state in states]),
        "state.sigma": np.array([np.sqrt(np.diagonal(state.joint)) for state in states]),
        "covariance": np.array([state.joint / np.sqrt(np.outer(*[np.diagonal(state.joint)] * 2)) for state in states]),
        "covariance.sigma": np.ones(1),
    }


def of_crossing(crossing: Any) -> dict[str, Any]:
    """Numbers of an event ahead."""
    if crossing is None:
        return {"none": "no event"}
    sigma = np.maximum(np.sqrt(np.diagonal(crossing.covariance)), 1e-9)
    return {"time": crossing.time, "state": crossing.state, "state.sigma": sigma, "sigma": crossing.time_sigma}


def call_estimate(folder: Path, _: int) -> Numbers:
    found: dict[str, Any] = {}
    for name, estimate in bf.estimate(folder / "shots").items():
        own = {
            "t": estimate.times,
            "contacts.time": np.array([c.time for c in estimate.contacts]),
            "notes": estimate.notes,
        }
        own |= {"states": estimate.states, "states.sigma": estimate.sigmas, "hits": estimate.hits}
        found |= {f"{name}.{key}": value for key, value in own.items()}
    return found


def call_ahead(folder: Path, _: int) -> Numbers:
    """The path of single tracks, and the events on it."""
    found: dict[str, Any] = {}
    for track in bf.read(folder / "shots"):
        ahead = bf.predict(track.opening(0.25), horizon=0.8, surfaces=0.76, settings=bf.Settings())
        own = {"t": ahead.times, "states": ahead.positions, "states.sigma": ahead.sigmas}
        events = {"contact": ahead.next_contact, "apex": ahead.apex, "plane": ahead.crossing(x=1.0)}
        own |= {f"{name}.{key}": v for name, event in events.items() for key, v in of_crossing(event).items()}
        found |= {f"{track.name}.{key}": value for key, value in own.items()}
    return found


def call_predict(folder: Path, _: int) -> Numbers:
    found: dict[str, Any] = {}
    for name, one in bf.predict(folder / "shots", observe=0.25, conformal=folder / "more" / "shots").items():
        found |= {f"{name}.t": one.times, f"{name}.p": one.positions, f"{name}.p.sigma": one.sigmas}
        found |= {f"{name}.sigmas": one.sigmas, f"{name}.estimate.t": one.estimate.times}
    return found


def call_noise(folder: Path, _: int) -> Numbers:
    data, model = bf.read(folder / "shots"), bf.nominal_model()
    found = estimate_noise(model, dataset_surfaces(data), dataset_settings(data, model), list(data)[:6])
    assert found is not None
    logs = {name: np.log(value) for name, value in flat(found.noise.to_mapping()) if value}
    return {**logs, "errors": np.array(list(found.relative_errors.values())), "starts": found.starts}


def call_push(folder: Path, _: int) -> Numbers:
    data, states = bf.read(folder / "shots"), []
    settings = dataset_settings(data, bf.nominal_model())
    for track in list(data)[:3]:
        for solver in ("ballfg", "gtsam"):
            live = bf.Online(bf.nominal_model(), dataset_surfaces(data), replace(settings, solver=solver))
            states += [live.push(t, p) for t, p in zip(track.times, track.positions, strict=True)]
    return of_states(states)


def call_tracker(folder: Path, _: int) -> Numbers:
    """All tracks one after the other; every seventh sample comes three frames late."""
    data = bf.read(folder / "shots")
    tracker = Tracker(bf.nominal_model(), dataset_surfaces(data), dataset_settings(data, bf.nominal_model()))
    updates = []
    for track in data:
        order = np.argsort(np.arange(len(track)) + np.where(np.arange(len(track)) % 7 == 5, 3.5, 0.0), kind="stable")
        for k in order:
            updates += tracker.push(float(track.times[k]), track.positions[k])
    updates += tracker.end()
    states = of_states([update.state for update in updates if update.state is not None])
    events = [event for update in updates for event in update.events]
    told = [(update.kind, update.ball, update.samples, update.reason) for update in updates]
    times = {"updates.t": np.array([u.time for u in updates]), "events.t": np.array([e.time for e in events])}
    return {**states, **times, "told": told, "events": [event.kind for event in events]}


def call_sightings(_: Path, shift: int) -> Numbers:
    """A sighted track by smoother and stream, and the time offsets of its cameras."""
    ball, found = world(), {}
    made = scene(3, ball)
    ticks = np.round(made.sightings.times * 1e6).astype(np.int64)
    stamps = np.array([float(text(shift + int(tick))) for tick in ticks])
    made = made._replace(sightings=Sightings(
        made.sightings.cameras, made.sightings.camera, stamps, made.sightings.pixels, made.sightings.covariances
    ))  # fmt: skip
    track, settings = track_of(made), bf.Settings()
    estimate = bf.Smoother(ball.model, ball.surfaces, settings).estimate(track)
    found |= {"t": estimate.times, "states": estimate.states, "states.sigma": estimate.sigmas}
    offsets = estimate_time_offsets([track], ball.model, ball.surfaces, settings)
    found |= {"offsets": np.array([c.time_offset for c in offsets.cameras]), "offsets.sigma": 1e-4}
    live = bf.Online(ball.model, ball.surfaces, replace(settings, solver="ballfg"), cameras=RIG)
    sightings = made.sightings
    rows = zip(sightings.times, sightings.camera, sightings.pixels, sightings.covariances, strict=True)
    states = [s for t, c, p, v in rows if (s := live.push_sighting(t, sightings.cameras[c], p, v)) is not None]
    return found | {f"live.{key}": value for key, value in of_states(states).items()}


def call_readings(folder: Path, shift: int) -> Numbers:
    """A radar's readings between samples."""
    states = []
    for track in list(bf.read(folder / "shots"))[:2]:
        ticks = [round(1e6 * (time - shift * 1e-6)) for time in track.times.tolist()]
        middle = [float(text(shift + (one + other) // 2)) for one, other in pairwise(ticks)]
        speeds = np.linalg.norm(np.diff(track.positions, axis=0), axis=1) * 120.0
        radar = bf.RadarSpeed.at(track, middle, speeds, 0.5)
        states += list(bf.estimate(track.observed(radar), surfaces=0.76, settings=bf.Settings()))
    return of_states(states)


CALLS = {
    "bf.estimate(folder)": call_estimate,
    "bf.predict(track), events ahead": call_ahead,
    "bf.predict(folder, observe=0.25, conformal)": call_predict,
    "estimate_noise": call_noise,
    "Online.push": call_push,
    "Tracker.push": call_tracker,
    "sightings: Smoother, push_sighting, time offsets": call_sightings,
    "RadarSpeed.at, bf.estimate": call_readings,
}
