"""A stream of a ball that hops ever lower, until no sample shows a single bounce: it stays on its surface."""

import numpy as np
import pytest
import torch

import ballfg as bf
from ballfg.dynamics import rollout

FROM = 0.3
"""s. Before that the stream hardly shows the velocity."""


@pytest.mark.parametrize(("drop", "rate", "noise", "until"), [(0.1, 100.0, 0.003, 3.2), (0.05, 60.0, 0.005, 2.5)])
def test_a_ball_whose_hops_get_lower_than_the_noise_never_falls_through_its_surface(drop, rate, noise, until):
    ball, surfaces, times = bf.nominal_model(), bf.Surfaces(0.0), np.arange(0.0, until, 1.0 / rate)
    settings, off = bf.Settings(position_noise=(noise,) * 3, solver="ballfg"), list[float]()
    for seed in range(100, 104):
        rng = np.random.default_rng(seed)
        start = [0.0, 0.0, drop, rng.uniform(0.3, 1.5), rng.uniform(-0.3, 0.3), 0.0, *rng.normal(0.0, 30.0, 3)]
        with torch.no_grad():
            truth = rollout(ball, torch.tensor([start]), torch.tensor(times), surfaces).numpy().reshape(-1, 9)
        live = bf.Online(ball, surfaces, settings)
        for t, p, z in zip(times, truth[:, :3] + rng.normal(0.0, noise, (len(times), 3)), truth[:, 2], strict=True):
            height = live.push(t, p).state[2]
            off += [height - z] if t > FROM else []
    errors = np.array(off)
    assert np.sqrt((errors**2).mean()) < 1.5 * noise
    assert (errors < -4.0 * noise).mean() < 0.02
