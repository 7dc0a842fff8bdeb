"""What is wrong with stamps becomes effects of the model that a fit begins with, and findings with their evidence."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ballfg.diagnosis.fit.holdout import hold_out
from ballfg.diagnosis.fit.stamps import Evidence, Stamps
from ballfg.diagnosis.hypotheses.hypothesis import with_effects
from ballfg.diagnosis.report.wording import in_plain_words
from ballfg.diagnosis.search.stamp_effects import as_declared, first_fit, stamp_findings, stamp_hypotheses
from ballfg.dynamics.effects.measurement import CountedFrames, TimeScale
from ballfg.simulation import SimulationConfig, write_simulation
from ballfg.tracks import read_dataset

EACH = (Evidence(0.5, 1e-9, 0.8), Evidence(0.4, 1e-5, 0.6))
"""On the search half, on the other half."""


@pytest.mark.parametrize(
    ("found", "named"),
    [
        ((), {}),
        (("counted_frames",), {"counted_frames": ("missing",)}),
        (("time_scale",), {"time_scale": ("s",)}),
        (("counted_frames", "time_scale"), {"counted_frames": (), "time_scale": ("s",)}),
    ],
)
def test_counted_frames_are_held_where_a_clock_is_fitted(found: tuple[str, ...], named: dict[str, tuple]) -> None:
    stamps = Stamps(missing=0.25, scale=0.3, found=dict.fromkeys(found, EACH))
    hypotheses = stamp_hypotheses(stamps)
    assert {h.name: tuple(h.strengths) for h in hypotheses} == named
    assert {name: value for h in hypotheses for name, value in h.shape.items()} == (
        {"missing": 0.25} if len(found) > 1 else {}
    )


def test_the_first_fit_finds_how_far_the_clock_is_off(make_ball, make_launches, make_shots, tmp_path: Path) -> None:
    clock = {"s": 0.3}
    written = make_shots(make_ball(time_scale=clock), make_launches(16, 3), 3).stretches
    stamps = Stamps(scale=0.27, found={"time_scale": EACH})  # as the fall of the balls tells it, roughly
    write_simulation(tmp_path / "any", SimulationConfig(tracks=6, rate=60.0, seed=3))
    holdout = hold_out(read_dataset(tmp_path / "any"), make_ball(), 1, lambda line: None)
    fit = first_fit(make_ball(), replace(holdout, search=written, stamps=stamps))
    (free,) = (name for name in fit.problem.free if name.endswith("time_scale.s"))
    assert fit.unknowns.values[free] == pytest.approx(0.3, abs=0.01)
    (finding,) = stamp_findings(fit, stamps, fit)
    assert finding.parameters["s"].value == fit.unknowns.values[free]
    assert in_plain_words(finding) == "The clock is wrong: durations are written 30 % too long."
    assert (finding.name, finding.kind, finding.p_value) == ("time_scale", "measurement", 1e-9)
    assert (finding.held_out_gain, finding.held_out_p) == (0.6, 1e-5)
    assert finding.delta_bic == pytest.approx(math.log(16) - 2.0 * 16 * 0.8)
    assert np.isfinite(fit.cost)


def test_the_declared_model_has_no_effects_on_stamps(make_ball) -> None:
    model = with_effects(make_ball(), CountedFrames(missing=0.25), TimeScale(s=0.1))
    stamps = Stamps(0.25, {}, 0.1, {"counted_frames": EACH, "time_scale": EACH})
    bare = as_declared(model, stamps)
    assert [*bare.state_dict()] == [*make_ball().state_dict()]
    assert as_declared(model, Stamps()) is model
