"""Halves of unlike shots: how tracks are split, and what that says about an effect that is not the right one."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from ballfg.diagnosis.evidence.halves import LEAST_SHARE, unlike_halves
from ballfg.diagnosis.evidence.odds import tempered
from ballfg.diagnosis.evidence.rows import random_motion
from ballfg.diagnosis.evidence.weighed import weighed
from ballfg.diagnosis.fit.free import Deviation
from ballfg.diagnosis.hypotheses.hypothesis import hypotheses, scene_of
from ballfg.diagnosis.search.refits import refit
from ballfg.diagnosis.search.score import Scored
from ballfg.dynamics import EFFECTS
from ballfg.state import SPIN, VELOCITY


def fit_of(states, rooms=None):
    """As much of a fit as the split reads: first states of tracks, each with two flights; the second room's tracks."""
    names = [f"{k:03d}" for k in np.repeat(np.arange(len(states)), 2)]
    stretches = SimpleNamespace(track=np.repeat(np.arange(len(states)), 2), names=names)
    second = {f"{k:03d}": 1.0 for k in np.flatnonzero(rooms)} if rooms is not None else {}
    deviations = {"e in the second": Deviation("bounce.restitution.e", second, "room", "second")} if second else {}
    return SimpleNamespace(
        problem=SimpleNamespace(stretches=stretches, deviations=deviations),
        unknowns=SimpleNamespace(starts=np.repeat(states, 2, axis=0)),
    )


def test_two_kinds_of_shots_are_the_two_halves():
    rng = np.random.default_rng(0)
    kind = rng.permutation(np.arange(20) % 2 == 0)
    states = rng.normal(size=(20, 9)) * 0.01
    states[:, VELOCITY] += [5.0, 0.0, 1.0]
    states[:, SPIN] += np.where(kind[:, None], [0.0, 150.0, 0.0], [0.0, -150.0, 0.0])
    halves = unlike_halves(fit_of(states))
    assert (halves == kind).all() or (halves != kind).all()


def test_halves_are_no_rooms():
    """Of rooms with launchers of their own both halves hold some, or nothing could be said about a room."""
    rng = np.random.default_rng(1)
    rooms = np.arange(24) % 3 == 0
    states = rng.normal(size=(24, 9)) * 0.3
    states[:, SPIN] += [0.0, 60.0, 0.0]
    states[:, VELOCITY] += np.where(rooms[:, None], [9.0, 0.0, 1.0], [4.0, 0.0, 2.0])
    alone, declared = unlike_halves(fit_of(states)), unlike_halves(fit_of(states, rooms))
    assert (alone == rooms).all() or (alone != rooms).all()
    assert 2 <= (declared & rooms).sum() <= 6
    assert 4 <= (declared & ~rooms).sum() <= 12


@pytest.mark.parametrize("odd", [0, 1])
def test_no_half_is_too_small_to_teach(odd):
    """Of equal shots, and beside a single one that is unlike all others."""
    states = np.tile(np.array([0.0, 0.0, 1.0, 5.0, 0.0, 1.0, 0.0, 50.0, 0.0]), (20, 1))
    states[:odd, VELOCITY] *= 3.0
    halves = unlike_halves(fit_of(states))
    assert LEAST_SHARE * 20 <= halves.sum() <= (1.0 - LEAST_SHARE) * 20


def test_a_wrong_effect_is_not_borne_out_by_unlike_shots(make_ball, make_launches, make_shots, make_fit):
    """Drag that grows with the spin, of shots with and without: a lens distorts both alike.

    What is left of it has to beat something nameless (`test_a_wrong_effect_alone_gets_no_name`).
    """
    launches = make_launches(24, 9, spread=0.1, spin=10.0)
    launches[::4, 7] += 150.0
    launches[1::4, 7] += 150.0
    shots = make_shots(make_ball(drag_spin={"gain": 1.5}), launches, 9, rate=60.0)
    declared = make_fit(make_ball(), shots.stretches)
    motion, alternating = random_motion(declared), np.arange(24) % 2 == 0

    def borne_out(name, halves):
        """The share of the promised evidence that the other half bears out."""
        hypothesis, *_ = hypotheses(declared.problem.model, scene_of(declared), [EFFECTS[name]])
        fit = refit(declared, Scored(hypothesis, None, 0.0)).fit
        nothing, model = (weighed(*one, motion, halves) for one in ((declared, ()), (fit, [hypothesis])))
        promised = model.evidence - nothing.evidence
        assert promised > 40.0
        own = {nothing.names: nothing}
        return (tempered(model.names, model, own) - nothing.evidence) / promised

    assert borne_out("distortion", alternating) == 1.0
    assert borne_out("distortion", unlike_halves(declared)) < borne_out("distortion", alternating)
    assert borne_out("drag_spin", unlike_halves(declared)) == 1.0
