"""From tracks to stretches: cut at hits and rests, outliers dropped, contacts and labels kept where they belong."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ballfg.diagnosis.fit.stretches import LEAST_SAMPLES, stretches_of
from ballfg.dynamics import Surfaces, rollout
from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.estimation.launcher import Launcher
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.tracks import Track

RATE, NOISE = 100.0, 0.002
TABLE = Surfaces(0.76, 0.0)
LAUNCHER = Launcher(SpinEmbedding(("group",), {"group": ("a", "b")}), 60.0)
SPIN = {"spin_x": 0.0, "spin_y": 80.0, "spin_z": 10.0}


def flown(model, start, count):
    """(count, 9) states at `RATE`."""
    times = torch.arange(count, dtype=torch.float64) / RATE
    with torch.no_grad():
        return rollout(model, torch.from_numpy(np.array(start)[None]), times, TABLE)[0].numpy()


def measured(name, states, labels, seed):
    noise = NOISE * np.random.default_rng(seed).standard_normal((len(states), 3))
    return Track(0.5 + np.arange(len(states)) / RATE, states[:, :3] + noise, labels=labels, name=name)


@pytest.fixture(scope="module")
def smoother(make_ball):
    return Smoother(make_ball(), TABLE, Settings(position_noise=(NOISE,) * 3, spin_label_noise=4.0))


@pytest.fixture(scope="module")
def first_flight(make_ball):
    """0.6 s with one bounce near 0.33 s."""
    return flown(make_ball(), (0.0, 0.0, 1.06, 4.5, 0.2, 0.6, 0.0, 80.0, 10.0), 60)


@pytest.fixture(scope="module")
def tracks(make_ball, first_flight):
    """A plain one with two outliers, one that is hit and comes back, one that is too short, one of a group."""
    back = first_flight[-1].copy()
    back[3:6], back[6:] = (-6.0, 0.5, 2.0), (0.0, -60.0, 0.0)
    returned = flown(make_ball(), back, 40)[1:]
    plain = measured("plain", first_flight, SPIN, 1)
    positions = plain.positions.copy()
    positions[[12, 45]] += (0.15, -0.1, 0.2)
    return [
        Track(plain.times, positions, labels=SPIN, name="plain"),
        measured("hit", np.concatenate((first_flight, returned)), SPIN, 2),
        measured("short", first_flight[: LEAST_SAMPLES - 2], SPIN, 3),
        measured("group", first_flight[:30], {"group": "b"}, 4),
    ]


@pytest.fixture(scope="module")
def found(smoother, tracks):
    return stretches_of(smoother, tracks, LAUNCHER)


def rows(found, name):
    return [i for i, n in enumerate(found.names) if n == name]


def test_outliers_are_dropped(found, tracks):
    (row,) = rows(found, "plain")
    used = found.used[row]
    times = found.times[row][used].numpy()
    assert not np.isin(np.round(times * RATE), [12, 45]).any()
    assert 54 <= int(used.sum()) <= 58
    kept = np.round(times * RATE).astype(int)
    np.testing.assert_array_equal(found.positions[row][used], tracks[0].positions[kept])


def test_contacts_and_starts(found, first_flight):
    (row,) = rows(found, "plain")
    height, contact = found.heights[row], found.contacts[row]
    assert height[~height.isnan()].tolist() == [0.76]
    after = int(np.flatnonzero(np.diff(first_flight[:, 5]) > 0)[0])  # vz turns in this interval
    assert after / RATE - 2e-3 < float(contact[0]) < (after + 1) / RATE + 2e-3
    np.testing.assert_allclose(found.starts[row, :6].numpy(), first_flight[0, :6], atol=0.1)
    np.testing.assert_array_equal(found.labels[row], list(SPIN.values()))


def test_a_hit_ends_a_stretch_and_begins_another(found):
    before, after = rows(found, "hit")
    assert found.track[before] == found.track[after] == 1
    assert found.labelled[[before, after]].tolist() == [True, False]  # nobody knows the spin after it
    assert float(found.ends[before]) == pytest.approx(0.59, abs=0.025)
    assert float(found.ends[after]) == pytest.approx(0.38, abs=0.025)
    assert float(found.starts[after, 3]) == pytest.approx(-6.0, abs=0.3)
    assert bool((found.times[after][found.used[after]] >= 0.0).all())
    last, first = found.positions[before][found.used[before]][-1], found.positions[after][found.used[after]][0]
    assert not torch.equal(last, first)  # no sample is in both
    assert 97 <= int(found.used[[before, after]].sum()) <= 99


def test_a_short_track_tells_nothing(found):
    assert rows(found, "short") == []


def test_launcher_settings(found):
    (row,) = rows(found, "group")
    assert found.settings[row].tolist() == [0.0, 1.0]
    assert not found.labelled[row]
    assert (found.settings[rows(found, "plain") + rows(found, "hit")] == 0.0).all()


def test_padding(found):
    for row, used in enumerate(found.used):
        count = int(used.sum())
        assert bool(used[:count].all())
        assert bool(found.sigmas[row, count:].isinf().all())
        assert bool((found.times[row, count:] == found.ends[row]).all())
        assert bool((found.times[row, 1:count] > found.times[row, : count - 1]).all())


def test_taking_some(found):
    chosen = found.take(found.labelled)
    assert len(chosen) == int(found.labelled.sum())
    assert chosen.labelled.all()
    again = found.take([2, 0])
    assert again.names == (found.names[2], found.names[0])
    np.testing.assert_array_equal(again.starts, found.starts[[2, 0]])


def test_a_rest_ends_a_stretch(make_ball, smoother):
    """A ball that is dropped from 5 cm, bounces itself out and rolls on."""
    states = flown(make_ball(restitution={"e": 0.5}), (0.0, 0.0, 0.88, 0.8, 0.0, 0.0, 0.0, 0.0, 0.0), 120)
    resting = np.flatnonzero(np.abs(states[:, 2] - 0.78) < 1e-4)[0] / RATE
    model = make_ball(restitution={"e": 0.5})
    own = Smoother(model, TABLE, Settings(position_noise=(NOISE,) * 3))
    (stretch,) = (stretches_of(own, [measured("drop", states, SPIN, 5)], LAUNCHER),)
    assert float(stretch.ends.max()) < resting + 0.1


def test_nothing_left(smoother, tracks):
    with pytest.raises(ValueError, match=r"free flights of at least 10 samples and 0\.08 s; none does\. Record longer"):
        stretches_of(smoother, [tracks[2]], LAUNCHER)
