import numpy as np
import pytest

from ballfg.benchmarks.estimators.protocols import AT_BOUNCE, FAIR_NOISE, PAPER_NOISE, fair_protocol, paper_protocol
from ballfg.state import POSITION, VZ


@pytest.mark.parametrize("protocol", [paper_protocol, fair_protocol])
def test_same_seed_same_tracks(protocol) -> None:  # type: ignore[no-untyped-def]
    one, two, other = protocol(3, 5), protocol(3, 5), protocol(3, 6)
    for a, b in zip(one.tracks, two.tracks, strict=True):
        assert a.track.positions.tobytes() == b.track.positions.tobytes()
        assert a.true_states.tobytes() == b.true_states.tobytes()
    assert not np.array_equal(one.tracks[0].track.positions, other.tracks[0].track.positions)


@pytest.mark.parametrize(("protocol", "noise"), [(paper_protocol, PAPER_NOISE), (fair_protocol, FAIR_NOISE)])
def test_measurements_have_the_declared_noise(protocol, noise: float) -> None:  # type: ignore[no-untyped-def]
    made = protocol(20, 0)
    errors = np.concatenate([c.track.positions - c.true_states[:, POSITION] for c in made.tracks])
    assert errors.std() == pytest.approx(noise, rel=0.04)
    assert made.settings.position_noise == (noise,) * 3


def test_paper_tells_the_true_spin_and_bounces_nowhere() -> None:
    made = paper_protocol(4, 0)
    for case in made.tracks:
        np.testing.assert_allclose(case.track.spin_label, case.true_states[0, 6:])
        assert np.ptp(case.true_states[:, 6:], axis=0).max() == 0.0
        assert case.away.all()


def test_fair_labels_are_noisy() -> None:
    made = fair_protocol(60, 0)
    errors = np.stack([c.track.spin_label - c.true_states[0, 6:] for c in made.tracks])
    assert errors.std() == pytest.approx(made.settings.spin_label_noise, rel=0.15)


def test_samples_at_a_bounce_are_few_and_next_to_one() -> None:
    made = fair_protocol(60, 0)
    excluded = [(c, int(i)) for c in made.tracks for i in np.flatnonzero(~c.away)]
    bounces = sum(int((np.diff(c.true_states[:, VZ]) > 0.5).sum()) for c in made.tracks)
    interval = 0.01
    assert 0.3 < len(excluded) / (bounces * 2 * AT_BOUNCE / interval) < 2.0  # a share 2 ms / 10 ms of the bounces
    for case, i in excluded:
        near = slice(max(i - 1, 0), i + 2)
        assert np.diff(case.true_states[near, VZ]).max() > 0.5
        assert case.true_states[i, 2] - made.surfaces.table_height < 0.03
