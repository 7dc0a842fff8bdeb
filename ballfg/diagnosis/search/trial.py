"""One round's trial of every hypothesis: score tests of all of them, and refits of those that deserve one."""

from collections.abc import Callable, Sequence

from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.search.candidates import (
    ALARM,
    Refit,
    Scored,
    refit,
    refit_driven,
    refit_usual,
    score_all,
    shortlist,
)
from ballfg.diagnosis.search.hypothesis import has_effect, hypotheses, scene_of
from ballfg.diagnosis.search.label_frames import frame_hypotheses
from ballfg.dynamics import Effect
from ballfg.dynamics.effects.measurement import SpinLabelFrame

LABELLED = 0.5
"""Share of flights whose spin must be labelled for an effect that multiplies spins to show in a score test."""


def try_hypotheses(
    before: Fit, catalogue: Sequence[type[Effect]], tell: Callable[[str], None]
) -> tuple[list[Scored], list[Refit]]:
    """Every hypothesis, the one that explains most first; and the refits, the best first."""
    model = before.problem.model
    listed = hypotheses(model, scene_of(before), catalogue)
    candidates = [h for h in listed if not set(h.columns) & set(before.problem.free)]
    tell(f"testing {len(candidates)} hypotheses")
    unlabelled = before.problem.stretches.labelled.mean() < LABELLED
    driven = [h for h in candidates if h.effect.multiplies_spin and unlabelled]
    scored = score_all(before, [h for h in candidates if h not in driven])
    leading, refits = shortlist(scored), []
    for candidate in leading:
        tell(f"fitting with {candidate.hypothesis.name}")
        shaped = [candidate]
        if candidate.hypothesis.effect is SpinLabelFrame:
            frames = frame_hypotheses(before, candidate.hypothesis)
            shaped = [Scored(frame, None, candidate.p_value) for frame in frames]
        refits += [refit(before, one) for one in shaped]
    called = {candidate.hypothesis.name for candidate in leading}
    for place, hypothesis in enumerate([s.hypothesis for s in scored]):
        if hypothesis.name in called or not hypothesis.usual or has_effect(model, hypothesis.name):
            continue
        tell(f"fitting with {hypothesis.name}, which balls usually have")
        fitted = refit_usual(before, hypothesis)
        if fitted.scored.p_value < ALARM:
            scored[place] = fitted.scored
            refits.append(fitted)
    for hypothesis in driven:
        tell(f"fitting with {hypothesis.name} and spins that nobody labelled")
        fitted = refit_driven(before, hypothesis)
        scored.append(fitted.scored)
        refits += [fitted] if fitted.scored.p_value < ALARM else []
    ranked = sorted(scored, key=lambda s: s.explained, reverse=True)
    return ranked, sorted(refits, key=lambda r: r.delta_bic)
