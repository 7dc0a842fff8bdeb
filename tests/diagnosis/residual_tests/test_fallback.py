"""The learned residual as the last resort: trained on what happened, judged as it is measured."""

from __future__ import annotations

import numpy as np
import pytest

from ballfg.diagnosis.hypotheses.hypothesis import with_effects
from ballfg.diagnosis.residual_tests import fallback
from ballfg.dynamics import EFFECTS, build, nominal_model
from ballfg.dynamics.trained import Trained
from ballfg.simulation import SimulationConfig, simulate
from ballfg.simulation.synthetic import dataset_info
from ballfg.tracks import read_dataset, write_dataset
from tests.small_networks import SMALL

COUNT = 12


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    config = SimulationConfig(tracks=COUNT, rate=60.0, seed=5, spin_labels=True)
    folder = tmp_path_factory.mktemp("fallback") / "tracks"
    write_dataset(folder, dataset_info(config), (s.track for s in simulate(config)), "csv")
    return read_dataset(folder)


def stretched():
    """A model whose cameras see lengths along x too large by 2 %."""
    model = with_effects(nominal_model(), EFFECTS["scale"](x=0.02))
    model.trained = Trained(process_noise={"acceleration": 0.05})
    return model


@pytest.mark.usefixtures("networks_in_torch")
def test_a_network_upon_a_model_with_a_measurement_effect(dataset, monkeypatch):
    def small(architecture, **given):
        return build(architecture.model_copy(update=SMALL), **given)

    monkeypatch.setattr(fallback, "build", small)
    base = stretched()
    network = fallback.learned_residual(base, dataset, list(dataset), epochs=2)  # it runs; it need not help
    assert network is not None
    assert network.base is base
    assert not network.measures_plainly


def test_tracks_lose_what_the_measurement_did(dataset):
    tracks, _ = fallback._as_happened(stretched(), dataset, list(dataset))
    assert len(tracks) == COUNT
    for happened, track in zip(tracks, dataset, strict=True):
        of_noise = 4 * 0.02 * dataset.info.position_noise  # shifts are those of estimated places
        np.testing.assert_allclose(happened.positions[:, 0] * 1.02, track.positions[:, 0], rtol=0, atol=of_noise)
        np.testing.assert_allclose(happened.positions[:, 1:], track.positions[:, 1:], rtol=0, atol=1e-9)


def test_few_tracks_make_no_network(dataset):
    assert (
        fallback.learned_residual(nominal_model(), dataset, list(dataset)[: fallback.LEAST_LEARNED - 1], epochs=2)
        is None
    )
