"""Measured tracks: every one is estimated, its innovations are what their covariances say, contacts are found."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest

from ballfg.dynamics import nominal_model
from ballfg.estimation.configure import dataset_settings, dataset_surfaces
from ballfg.estimation.result import Estimate, Status
from ballfg.estimation.segmentation.result import Quality
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.tracks import read_dataset
from tests.places import DATA


def estimates(name: str, count: int, *, shortest: bool = False) -> list[Estimate]:
    folder = DATA / name
    if not folder.is_dir():
        pytest.skip(f"no measured tracks at {folder}; set BALLFG_DATA to the folder that holds {name}")
    dataset = read_dataset(folder)
    model = nominal_model(dataset.info.ball)
    smoother = Smoother(model, dataset_surfaces(dataset), dataset_settings(dataset, model))
    tracks = sorted(dataset, key=len) if shortest else dataset
    return [smoother.estimate(track) for track in islice(iter(tracks), count)]


def within(found: list[Estimate], sigmas: float) -> float:
    """Share of samples, away from hits and not set aside as bad, all of whose innovations lie within some sigmas."""
    inside = []
    for estimate in found:
        used = estimate.quality <= Quality.WIDE
        for hit in estimate.hits:
            used[max(hit - 1, 0) : hit + 3] = False
        inside.append((np.abs(estimate.whitened[used]) < sigmas).all(axis=1))
    return float(np.concatenate(inside).mean())


def sound(found: list[Estimate]) -> None:
    for estimate in found:
        assert estimate.status is Status.OK, estimate.name
        assert np.isfinite(estimate.states).all()
        sigma = estimate.sigmas
        correlation = estimate.covariances / (sigma[:, :, None] * sigma[:, None, :])
        assert np.linalg.eigvalsh(correlation).min() > 0


def test_robot_rallies() -> None:
    """Eight of the shorter logs: bounces, hits, rolling. Required is 98 % within 5 sigma."""
    found = estimates("robot_rallies", 8, shortest=True)
    sound(found)
    assert within(found, 5.0) >= 0.98
    assert sum(len(estimate.contacts) for estimate in found) > 8
    assert sum(len(estimate.hits) for estimate in found) > 4


@pytest.mark.parametrize("name", ["aimy", "ballgun"])
def test_launched_balls(name) -> None:
    """Most shots of the first dozen bounce once; no sample is a surprise."""
    found = estimates(name, 12)
    sound(found)
    assert within(found, 5.0) >= 0.98
    assert sum(len(estimate.contacts) >= 1 for estimate in found) >= 9
    for estimate in found:
        times = [contact.time for contact in estimate.contacts]
        assert times == sorted(times)
        assert all(estimate.times[0] <= t <= estimate.times[-1] for t in times)
        for contact in estimate.contacts:  # down before it, up after it
            assert estimate.states[contact.interval, 5] < 0.0 < estimate.states[contact.interval + 1, 5]


def test_a_contact_at_the_end_must_explain_the_track_better() -> None:
    """The last sample of this track lies 13 mm below the table; a second bounce there would explain it worse."""
    if not (DATA / "spindoe").is_dir():
        pytest.skip(f"no measured tracks at {DATA / 'spindoe'}; set BALLFG_DATA to the folder that holds it")
    dataset = read_dataset(DATA / "spindoe")
    model = nominal_model(dataset.info.ball)
    smoother = Smoother(model, dataset_surfaces(dataset), dataset_settings(dataset, model))
    assert len(smoother.estimate(dataset.track("002")).contacts) == 1
