"""Simulated tracks for the online estimator, and how far its answers are from others."""

import numpy as np
import torch
from torch import nn

from ballfg.dynamics import BallModel, Surfaces, nominal_model, rollout
from ballfg.estimation.online.windows import interval
from ballfg.estimation.settings import Settings
from ballfg.factors.batch import merge
from ballfg.tracks import Track

SIGMA = 0.002
TABLE = Surfaces(0.0, -0.76)
NOWHERE = Surfaces(-20.0)
FLYING = (0.0, 0.0, 0.4, 5.0, 0.5, 2.0, 0.0, 80.0, 20.0)
BOUNCING = (0.0, 0.0, 0.3, 5.0, 0.5, 0.5, 0.0, 10.0, 20.0)
SAME = 1e-4
"""Posterior standard deviations: how far `estimate` may lie from the smoother; 1e-6 is what it does."""
LIVE = 0.05
"""The same for the running answer in flight with a squared loss; 0.01 is what it does."""
LIVE_BOUNCE = 0.3
"""And after a bounce, whose friction has a kink between sliding and rolling; up to 0.17 was seen."""


class NetworkModel(BallModel):
    """The nominal ball plus a 9-80-80-3 tanh network with small weights."""

    def __init__(self):
        super().__init__(0.02)
        torch.manual_seed(3)
        self.ball = nominal_model()
        self.net = nn.Sequential(nn.Linear(9, 80), nn.Tanh(), nn.Linear(80, 80), nn.Tanh(), nn.Linear(80, 3)).double()

    def rates(self, state):
        velocity, spin = state[..., 3:6], state[..., 6:9]
        features = torch.cat((velocity / 5, spin / 100, torch.linalg.cross(spin, velocity) / 500), dim=-1)
        return self.ball.rates(state)[0] + 0.5 * self.net(features), None

    def after_bounce(self, state):
        return self.ball.after_bounce(state)


def make_track(start, n=50, *, model=None, surfaces=TABLE, seed=0, dt=0.01, labels=None):
    times = np.arange(n) * dt
    state = torch.tensor([start], dtype=torch.float64)
    truth = rollout(model or nominal_model(), state, torch.from_numpy(times), surfaces)[0].detach().numpy()
    noise = SIGMA * np.random.default_rng(seed).standard_normal((n, 3))
    return Track(times, truth[:, :3] + noise, labels=labels or {}, name="shot"), truth


def settings(**changes):
    return Settings(position_noise=(SIGMA,) * 3, **changes)


def feed(online, track):
    return [online.push(t, z) for t, z in zip(track.times.tolist(), track.positions, strict=True)]


def fed_and_counted(online, track, monkeypatch):
    """The states of `feed`, and (n,) how many factors of the motion each push evaluated, (n,) in how many calls."""
    states, counts = [], np.zeros((len(track), 2), dtype=int)

    def counted(batches):
        counts[len(states)] += len(batches), 1
        return merge(batches)

    with monkeypatch.context() as patched:
        patched.setattr(interval, "merge", counted)
        for t, z in zip(track.times.tolist(), track.positions, strict=True):
            states.append(online.push(t, z))
    return states, *counts.T


def distance(states, estimate):
    """Largest difference in posterior standard deviations."""
    return np.abs((states - estimate.states) / estimate.sigmas).max()
