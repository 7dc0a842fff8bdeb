"""Models without some of their effects, by the two ways that lead there."""

from __future__ import annotations

from dataclasses import replace

from ballfg.diagnosis.evidence.halves import unlike_halves
from ballfg.diagnosis.evidence.rows import random_motion
from ballfg.diagnosis.evidence.weighed import weigh, weighed
from ballfg.diagnosis.hypotheses.hypothesis import hypotheses, scene_of
from ballfg.diagnosis.search.models import smaller_fit, weighed_without, without_named
from ballfg.diagnosis.search.refits import refit
from ballfg.diagnosis.search.score import Scored
from ballfg.dynamics import EFFECTS


def test_steps_of_the_fit_are_tried_where_the_linearised_step_ends_below_what_it_promised(
    make_ball, make_launches, make_shots, make_fit
):
    """Wind and a tilted frame, then the wind alone: the more probable one of both ways counts."""
    true = make_ball(wind={"x": 0.5, "y": -0.3})
    fit = make_fit(make_ball(), make_shots(true, make_launches(16, 13), 13, rate=40.0).stretches)
    wind, tilt = (
        next(h for h in hypotheses(fit.problem.model, scene_of(fit), [EFFECTS[n]])) for n in ("wind", "frame_tilt")
    )
    with_wind = refit(fit, Scored(wind, None, 0.0)).fit
    both = weigh(refit(with_wind, Scored(tilt, None, 0.0)).fit, [wind, tilt])
    motion, halves = random_motion(fit), unlike_halves(fit)
    alone = frozenset([wind.name])
    promised = replace(both, nested={alone: replace(both.nested[alone], evidence=both.nested[alone].evidence + 1e3)})
    by_step, by_fit = (
        weighed(start(both.fit if start is without_named else both, [tilt], fit), [wind], motion, halves, both).score
        for start in (smaller_fit, without_named)
    )
    assert by_fit > by_step + 0.05
    assert weighed_without(both, [tilt], fit, motion, halves).score == by_step
    assert weighed_without(promised, [tilt], fit, motion, halves).score == by_fit
