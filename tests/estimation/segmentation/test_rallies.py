"""Bouncing and hit balls, with all that a tracker adds: every contact and hit is found, and nothing else."""

import numpy as np
import pytest

from ballfg.dynamics import Surfaces, nominal_model
from ballfg.estimation.segmentation.physics import physics_of
from ballfg.estimation.segmentation.result import Quality
from tests.estimation.segmentation.whole_tracks import segment

PHYSICS = physics_of(nominal_model())
SIGMA = 0.0015


def segmented(truth, times, positions, sigma=SIGMA):
    return segment(times, positions, sigma, surfaces=Surfaces(0.75), physics=PHYSICS)


def intervals(times, stamps):
    """The intervals of a thinned track in which given times lie."""
    return [int(np.searchsorted(times, stamp + 1e-9)) - 1 for stamp in stamps]


def compare(rallies, match, change, sigma=SIGMA):
    """Missed and false contacts, missed and false hits, over all rallies, after a change of what is measured."""
    counts = np.zeros(4, dtype=int)
    contacts = 0
    for seed, truth in enumerate(rallies):
        rng = np.random.default_rng(seed)
        times, positions = change(truth, rng)
        found = segmented(truth, times, positions, sigma)
        end = times[-1] - 0.02  # after a contact this late there is too little to see
        true_contacts = intervals(times, [t for t in truth.times[truth.contacts] if t < end])
        near_end = [c for c in found.contacts if c.time < end]
        contacts += len(true_contacts)
        counts += [
            *match([c.interval for c in near_end], true_contacts),
            *match(found.hits.tolist(), intervals(times, truth.times[truth.hits]), 2),
        ]
    assert contacts >= 30
    return counts.tolist()


def test_all_events_of_plain_rallies_are_found(rallies, match):
    assert compare(rallies, match, lambda truth, rng: (truth.times, truth.measured(rng))) == [0, 0, 0, 0]


def test_several_hits_in_a_row(make_rally, match):
    rallies = [make_rally(100 + seed, hits=3, duration=3.0) for seed in range(3)]
    for seed, truth in enumerate(rallies):
        found = segmented(truth, truth.times, truth.measured(np.random.default_rng(seed)))
        assert match(found.hits.tolist(), truth.hits, 2) == (0, 0)
        assert len(found.segments) == len(truth.hits) + 1
        assert found.segments[0][0] == 0
        assert found.segments[-1][1] == len(truth.times) - 1


def test_contact_times_and_heights(rallies):
    """Where the vertical velocity changes sign, from the states on both sides; noise of 1.5 mm gives 0.5 ms."""
    late = []
    for seed, truth in enumerate(rallies):
        found = segmented(truth, truth.times, truth.measured(np.random.default_rng(seed)))
        for contact in found.contacts:
            i = contact.interval
            assert contact.height == 0.75
            if i in truth.contacts:
                z, vz = truth.states[i, 2], truth.states[i, 5]
                gap = z - 0.75 - PHYSICS.radius - PHYSICS.surface_offset
                late.append(contact.time - truth.times[i] - (vz + np.sqrt(vz**2 + 2 * 9.81 * gap)) / 9.81)
    assert len(late) > 30
    assert np.median(np.abs(late)) < 1e-3


@pytest.mark.parametrize("share", [0.02, 0.08])
def test_outliers_are_marked_and_change_nothing(rallies, match, share):
    marked = planted = false = 0

    def spoil(truth, rng):
        positions = truth.measured(rng)
        bad = np.flatnonzero(rng.random(len(positions)) < share)
        direction = rng.normal(size=(len(bad), 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        positions[bad] += direction * rng.uniform(0.05, 0.3, (len(bad), 1))
        nonlocal marked, planted, false
        quality = segmented(truth, truth.times, positions).quality
        marked += int((quality[bad] == Quality.OUTLIER).sum())
        planted += len(bad)
        false += int((quality == Quality.OUTLIER).sum()) - int((quality[bad] == Quality.OUTLIER).sum())
        return truth.times, positions

    assert compare(rallies, match, spoil) == [0, 0, 0, 0]
    assert marked >= 0.97 * planted
    assert false <= 2


def test_runs_shifted_by_an_offset_are_marked_and_are_no_hits(rallies, match):
    marked = planted = false = 0

    def shift(truth, rng):
        positions = truth.measured(rng)
        free = [i for i in range(20, 300) if min(abs(i - k) for k in truth.contacts + truth.hits) > 25]
        first = int(rng.choice(free))
        run = slice(first, first + int(rng.integers(3, 20)))
        positions[run] += [0.001, 0.035, -0.015]
        nonlocal marked, planted, false
        shifted = segmented(truth, truth.times, positions).quality == Quality.SHIFTED
        marked += int(shifted[run].sum())
        planted += run.stop - run.start
        false += int(shifted.sum() - shifted[run].sum())
        return truth.times, positions

    assert compare(rallies, match, shift) == [0, 0, 0, 0]
    assert marked >= 0.9 * planted
    assert false <= 0.05 * planted


@pytest.mark.parametrize("run", [3, 6, 20])
@pytest.mark.parametrize("size", [0.035, 0.08])
def test_a_shifted_run_across_a_contact_loses_nothing(rallies, match, run, size):
    counts, planted = np.zeros(4, dtype=int), 0
    for seed, truth in enumerate(rallies):
        rng = np.random.default_rng(seed)
        free = [c for c in truth.contacts if 25 < c < 310 and all(abs(c - hit) > 60 for hit in truth.hits)]
        for contact in free:
            positions = truth.measured(rng)
            direction = rng.normal(size=3)
            first = contact - int(rng.integers(0, run - 1))
            positions[first : first + run] += size * direction / np.linalg.norm(direction)
            found = segmented(truth, truth.times, positions)
            early = [c for c in truth.contacts if c < 355]
            counts += [
                *match([c.interval for c in found.contacts if c.interval < 355], early),
                *match(found.hits.tolist(), truth.hits, 2),
            ]
            planted += 1
    assert planted >= 10
    assert counts[:2].max() <= 1
    assert counts[2:].tolist() == [0, 0]


def test_an_outlier_right_after_a_hit(rallies, match):
    for after in (1, 2, 3):
        for seed, truth in enumerate(rallies):
            positions = truth.measured(np.random.default_rng(seed))
            positions[truth.hits[0] + after] += [0.1, -0.03, 0.05]
            found = segmented(truth, truth.times, positions)
            assert len(found.hits) == 1
            assert match(found.hits.tolist(), truth.hits, 2) == (0, 0)
            assert found.quality[truth.hits[0] + after] >= Quality.WIDE


@pytest.mark.parametrize(("every", "rate"), [(2, 90), (3, 60), (6, 30)])
def test_slow_trackers(rallies, match, every, rate):
    thinned = compare(rallies, match, lambda truth, rng: (truth.times[::every], truth.measured(rng)[::every]))
    assert sum(thinned) <= 1, f"{rate} Hz: {thinned}"


def test_a_gap_of_200_ms_hides_nothing(rallies, match):
    def cut(truth, rng):
        positions = truth.measured(rng)
        start = rng.uniform(0.2, 1.3)
        keep = (truth.times < start) | (truth.times > start + 0.2)
        return truth.times[keep], positions[keep]

    missed_contacts, false_contacts, missed_hits, false_hits = compare(rallies, match, cut)
    assert missed_contacts + false_contacts <= 2
    assert (missed_hits, false_hits) == (0, 0)


@pytest.mark.parametrize("error", [-0.01, 0.01])
def test_a_table_some_millimetres_off(rallies, match, error):
    assert compare(rallies, match, lambda t, rng: (t.times, t.measured(rng) + np.array([0, 0, error]))) == [0, 0, 0, 0]


@pytest.mark.parametrize(("true", "told"), [(0.0003, 0.0003), (0.003, 0.0015), (0.005, 0.005)])
def test_other_noise_and_noise_told_wrong(rallies, match, true, told):
    counts = compare(rallies, match, lambda t, rng: (t.times, t.measured(rng, true)), told)
    assert sum(counts[:2]) <= 2
    assert counts[2:] == [0, 0]


def test_noise_can_differ_between_samples(make_rally):
    truth = make_rally(0, hits=0, duration=0.3)
    rng = np.random.default_rng(0)
    sigma = np.full((len(truth.times), 3), SIGMA)
    sigma[20:30] = 0.03
    positions = truth.states[:, :3] + rng.normal(0, sigma)
    found = segment(truth.times, positions, sigma, surfaces=Surfaces(0.75), physics=PHYSICS)
    assert len(found.hits) == 0
    assert found.usable.all()


def test_a_hit_in_the_interval_of_a_contact_is_found_by_the_second_look(make_flight):
    """A ball that bounces and touches the net at once loses more of its speed than friction can take."""
    times = np.arange(0, 0.8, 1 / 180)
    start = [0, -1, 1.0, 0, 4, 0, 0, 0, 0]
    plain = make_flight(nominal_model(), start, times, Surfaces(0.75))
    i = plain.contacts[0]
    blocked = plain.states[i + 1, 3:6] * [1.0, 0.6, 1.0]
    truth = make_flight(nominal_model(), start, times, Surfaces(0.75), {i + 1: blocked})
    rng = np.random.default_rng(0)
    found = segmented(truth, times, truth.measured(rng))
    assert abs(found.contacts[0].interval - i) <= 1
    assert len(found.hits) == 1
    assert abs(int(found.hits[0]) - i) <= 1
    assert len(segmented(plain, times, plain.measured(rng)).hits) == 0


def test_only_contacts_forgets_the_rest(rallies):
    truth = rallies[0]
    found = segmented(truth, truth.times, truth.measured(np.random.default_rng(0)))
    assert len(found.hits) == 1
    only = found.only_contacts()
    assert only.contacts == found.contacts
    assert len(only.hits) == len(only.restarts) == 0
    assert only.usable.all()
    assert only.segments == [(0, len(truth.times) - 1)]
