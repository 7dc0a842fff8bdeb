"""Writes the first lines of a report for any reader: the finding, its certainty, and the next step."""

import math
import re
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from ballfg.diagnosis.fit.patterns import EVERYWHERE
from ballfg.diagnosis.generic_test import ALARM, APART, PREDICTED
from ballfg.diagnosis.report import wording
from ballfg.diagnosis.residual_tests.label_check import LABEL
from ballfg.diagnosis.result import Candidate, Diagnosis, Errors, Finding, Outcome, Verdict
from ballfg.dynamics import EFFECTS
from ballfg.estimation.noise.tracker_errors import NUMBERS

PLACES: Final = {
    "flight": "in flight",
    "contact": "at bounces",
    "measurement": "in the measured positions",
    "recording": "along the recording",
    APART: "from track to track",
    "label": "in the spin labels",
    "time": "from sample to sample",
    PREDICTED: "in predictions",
}
"""Beginning of a test's words, and the same within a sentence."""
SURE: Final = ((1e-6, "practically certain"), (1e-3, "very likely"), (0.05, "likely"))
"""Words for the probability that a finding is false; the larger one of both halves of the tracks counts."""
SKEWED: Final = 1.5  # Ratio of the root mean square to the median track's error beyond which the median is reported
MAIN: Final = ("wind", "drag_speed", "time_scale", "scale", "frame_tilt")
"""Effects whose detectable size is in the first lines of a report without findings."""
MOST_OTHERS: Final = 3  # Largest number of effects that a sentence lists beside one that it cannot tell them from
COUNTS: Final = ("No", "One", "Two", "Three", "Four", "Five", "Six", "Seven", "Eight", "Nine")


@dataclass(frozen=True)
class Origin:
    """The inputs of a report, as the user typed them: command line, folders of the datasets, files."""

    command: str
    datasets: tuple[str, ...]
    model: str  # The declared model's file; empty for the nominal model
    out: str
    models: tuple[str, ...] = ("model.yaml",)
    """File of the corrected model of each dataset, in the folder `out` of the report."""
    doubts: tuple[str, ...] = ()  # What is not sure about the tracks


def answer(diagnosis: Diagnosis) -> str:
    """The verdict in two or three words."""
    only_noise = diagnosis.findings and all(f.name in NUMBERS for f in diagnosis.findings)
    return "noise found" if diagnosis.verdict is Verdict.FOUND and only_noise else diagnosis.verdict.value


def not_shown(diagnosis: Diagnosis) -> list[Candidate]:
    """Effects that the last round tested without evidence, with their detectable sizes.

    None if a pattern remains: it may hide them. Effects that differ between tracks are left out: their size depends on
    the group of tracks and the place of a change.
    """
    if diagnosis.verdict is Verdict.UNEXPLAINED or not diagnosis.rounds:
        return []
    quiet = (
        c
        for c in diagnosis.rounds[-1]
        if c.outcome is Outcome.NOT_NEEDED and not c.name.endswith((wording.BY_GROUP, wording.DRIFT))
    )
    return [c for c in quiet if c.seen_from and all(map(math.isfinite, c.seen_from.values()))]


def headline(diagnosis: Diagnosis) -> str:
    """The answer for a reader without knowledge of the model and statistics, and the gain of predictions."""
    effects = [f for f in diagnosis.findings if f.name not in NUMBERS]
    if not effects and diagnosis.verdict is not Verdict.UNEXPLAINED:
        nothing = "No effect on the ball is missing" if diagnosis.findings else "Nothing that the model lacks was found"
        return f"{nothing}: {_quality(diagnosis)}, and what is left looks like noise."
    described, alone = diagnosis.unexplained.fallback, ""
    if not effects:
        left = where(diagnosis.unexplained.where)
        said = f"Something is missing from the model that no known effect explains: {left}."
        what = "" if described is None else "With a description of the pattern that names no cause"
    elif len(effects) == 1:
        others, what = effects[0].indistinguishable_from, "With it"
        doubt = f" It may also be {_or(others)}: these tracks cannot tell." if others else ""
        said = wording.in_plain_words(effects[0]) + doubt
    else:
        count = COUNTS[len(effects)] if len(effects) < len(COUNTS) else f"{len(effects)}"
        said, what = f"{count} effects are missing from the model.", "With them"
    if effects and described is not None:
        alone = f"{what} alone, by {described.before.prediction_rmse_mm:.1f} mm."
        what = f"{what} and a description of the rest that names no cause"
    more = "Something else is missing too." if effects and diagnosis.verdict is Verdict.UNEXPLAINED else ""
    return " ".join(part for part in (said, gain(diagnosis, what), alone, more) if part)


def further(diagnosis: Diagnosis) -> Iterator[str]:
    """Sentences on further findings: several effects one by one, the tracker, and unexplained patterns."""
    effects = [f for f in diagnosis.findings if f.name not in NUMBERS]
    if len(effects) > 1:
        yield from (wording.in_plain_words(f) for f in effects)
    for f in (f for f in diagnosis.findings if f.name in NUMBERS):
        said = wording.in_plain_words(f)
        yield f"Not an effect on the ball but noise of the measurements: {said[:1].lower()}{said[1:]}"
    if effects and diagnosis.verdict is Verdict.UNEXPLAINED:
        yield f"What else is missing no known effect explains: {where(diagnosis.unexplained.where)}."


def gain(diagnosis: Diagnosis, what: str) -> str:
    """The gain of predictions, in one sentence; what: the change, as in `With it`."""
    before, after = diagnosis.before.prediction_rmse_mm, diagnosis.after.prediction_rmse_mm
    if not what or not math.isfinite(before + after):
        return f"Predictions are off by {_error(diagnosis)}." if math.isfinite(after) else ""
    if medians := skewed_medians(diagnosis.before, diagnosis.after):  # one ball that misses the table may dominate
        least, most = (f"{median:.1f}" for median in reversed(medians))
        return f"{what}, half of the tracks are predicted to {least} mm or better; before, to {most} mm."
    if f"{before:.1f}" == f"{after:.1f}":
        return f"{what}, predictions are off by as much as before, {after:.1f} mm."
    return f"{what}, predictions are off by {after:.1f} instead of {before:.1f} mm."


def of_population(diagnosis: Diagnosis) -> str:
    """What the population of spins is worth, in one sentence; empty without one."""
    bare = diagnosis.unpopulated
    if bare is None or bare is diagnosis.before:
        return ""
    return (
        f"How the spins of these launches scatter is known from the other tracks: with the prior of any spin, the "
        f"declared model would be off by {bare.prediction_rmse_mm:.1f} mm."
    )


def skewed_medians(before: Errors, after: Errors) -> tuple[float, float] | None:
    """mm, errors of the median track before and after, if a few tracks dominate the root mean square."""
    was, now = (float(np.nanmedian(e.by_track)) if np.isfinite(e.by_track).any() else math.nan for e in (before, after))
    skewed = before.prediction_rmse_mm > SKEWED * was or after.prediction_rmse_mm > SKEWED * now
    return (was, now) if skewed else None


def certainty(diagnosis: Diagnosis) -> Iterator[str]:
    """The certainty of the answer: a line for each finding, or the basis for finding none."""
    for finding in diagnosis.findings:
        yield f"{wording.capital(wording.plain_name(finding.name))}: {_sure(finding)}"
    last = diagnosis.rounds[-1] if diagnosis.rounds else ()
    unseen = sum(c.outcome is Outcome.INVISIBLE for c in last)
    if diagnosis.verdict is Verdict.NOTHING and last:
        yield (
            f"{len(last) - unseen} effects were tested, one by one, and none of them stands out from chance. "
            f"The predictions of {diagnosis.tracks_judged_on} tracks were compared with what was measured."
        )
        quiet = {c.name: c for c in not_shown(diagnosis)}
        if noticed := wording.joined(tuple(_least(quiet[name]) for name in MAIN if name in quiet)):
            yield f"These would have been noticed in 9 of 10 recordings like this one, from such a size on: {noticed}."
    if unseen:
        yield f"These tracks say nothing about {unseen} more effect{'s' * (unseen > 1)}, which may be there or not."
    if diagnosis.nameless > 0.5:
        yield (
            "Something that no effect of the catalogue describes is there with a probability of "
            f"{100.0 * min(diagnosis.nameless, wording.MOST_CERTAIN):.3g} %; named effects are needed beside it."
        )
    if diagnosis.verdict is Verdict.UNEXPLAINED and diagnosis.unexplained.tests:
        tests = diagnosis.unexplained.tests
        of_labels = [test.p_value for test in tests if test.name == LABEL and test.p_value < ALARM]
        least = min((test.p_value for test in tests if test.name != LABEL), default=1.0)
        if least < ALARM or not of_labels:
            said = f"Chance makes such a pattern with probability {wording.probability(least)}."
            yield f"That something is left: {_sure_word(least)}. {said}"
        for all_right in of_labels:
            said = f"All of them are right with probability {wording.probability(all_right)}."
            yield f"That some spin labels are wrong: {_sure_word(all_right)}. {said}"


def advice(diagnosis: Diagnosis, origin: Origin) -> Iterator[tuple[str, str]]:
    """The next step: a sentence, and the command to type (or empty)."""
    rooms = list(zip(origin.datasets, origin.models, strict=True))
    datasets = " ".join(map(shlex.quote, origin.datasets))
    given = f" --model {shlex.quote(origin.model)}" if origin.model else ""
    again = shlex.quote(f"{origin.out.rstrip('/')}_again")
    estimate = "\n".join(_command("estimate", "states", *room, origin) for room in rooms)
    if diagnosis.findings or diagnosis.unexplained.fallback is not None:
        yield "Estimate the states with the corrected model:", estimate
        yield (
            "Predict with the corrected model, from the first 0.3 s of each track:",
            "\n".join(_command("predict", "predictions", *room, origin, " --observe 0.3") for room in rooms),
        )
    else:
        yield (
            "Keep the model that you have, or take the same one with its coefficients fitted to these tracks:",
            estimate,
        )
        yield "Once there are more tracks, look again:", f"ballfg diagnose {datasets}{given} --out {again}"
    for finding in (f for f in diagnosis.findings if f.indistinguishable_from):
        for name in (finding.name, *finding.indistinguishable_from[:MOST_OTHERS]):
            decide = finding.decide if name == finding.name else EFFECTS[name].decide if name in EFFECTS else ""
            if decide:
                yield f"To find out whether it is {wording.plain_name(name)}: {decide}", ""
    if diagnosis.verdict is Verdict.UNEXPLAINED:
        left = diagnosis.unexplained.where
        yield (
            f"Look for a cause of what is left ({where(left)}): {_to_look_at(left)}. If you have a suspicion, write it "
            "as an effect of your own and diagnose again:",
            f"ballfg diagnose {datasets}{given} --effects-file my_effects.py --out {again}",
        )


def _to_look_at(pattern: str) -> str:
    """An experiment for the cause of a pattern, by the kind of its test."""
    if pattern.startswith("label: "):
        return "measure the spin of these tracks once more, and check the axes and the unit of the labels"
    if pattern.startswith("time: "):
        return "look for what delays or smooths the positions between the camera and the file"
    if pattern.startswith(f"{APART}: "):
        return "note for each shot which ball flew and what else was changed, as labels; or fly one ball at one setting"
    if pattern.startswith(f"{PREDICTED}: "):
        return "compare the worst tracks with the others, and see what changes with every second track"
    if EVERYWHERE in pattern:
        return "record tracks at other speeds, spins and places than these"
    return "record tracks in which it varies more"


def _command(name: str, makes: str, dataset: str, model: str, origin: Origin, more: str = "") -> str:
    """A command on one of the datasets with the model of its room; of several each writes a file of its own."""
    known = shlex.quote(f"{origin.out.rstrip('/')}/{model}")
    out = f"{makes}.csv" if len(origin.datasets) == 1 else f"{makes}.{Path(model).stem.partition('.')[2]}.csv"
    return f"ballfg {name} {shlex.quote(dataset)} --model {known}{more} --out {shlex.quote(out)}"


def _least(candidate: Candidate) -> str:
    """The detectable size of an effect; for a vector in any direction along the axes."""
    worst = max(candidate.seen_from, key=candidate.seen_from.__getitem__)
    size, unit = candidate.seen_from[worst], candidate.estimate[worst].unit
    said = f"{wording.number(100 * size, 2)} %" if unit == "1" else wording.sized(size, unit)
    return f"{wording.plain_name(candidate.name)} ({said}{' along any axis' if len(candidate.seen_from) > 1 else ''})"


def where(words: str) -> str:
    """The place of a pattern, within a sentence: `in flight, acceleration along the flight is off ...`."""
    kind, sign, rest = words.partition(": ")
    known = PLACES.get(kind)
    return f"{known}, {rest.rstrip('.')}" if sign and known else re.sub(r"^In ", "in ", words.rstrip("."))


def _sure(finding: Finding) -> str:
    worst = max(p for p in (finding.p_value, finding.held_out_p, 0.0) if math.isfinite(p))
    sure = (
        f"{_sure_word(worst)}. Chance makes a trace so strong with probability {wording.probability(finding.p_value)}"
    )
    if math.isfinite(finding.held_out_p):
        by_chance = wording.probability(finding.held_out_p)
        sure += f"; its strength, fitted to half of the tracks, helps on the other half (by chance: {by_chance})"
    if others := finding.indistinguishable_from:
        sure += f". That something like it is there is sure; but it may be {_or(others)} as well"
    return f"{sure}."


def _sure_word(p: float) -> str:
    return next((word for limit, word in SURE if p < limit), "possible")


def _or(names: Sequence[str]) -> str:
    more = len(names) - MOST_OTHERS
    of_more = [f"one of {more} others"] if more > 0 else []
    return " or ".join([*(wording.plain_name(name) for name in names[:MOST_OTHERS]), *of_more])


def _quality(diagnosis: Diagnosis) -> str:
    """How well a model without additions predicts."""
    if medians := skewed_medians(diagnosis.after, diagnosis.after):
        return f"half of the tracks are predicted to {wording.fixed(medians[0], 1)} mm or better"
    return f"its predictions are off by {_error(diagnosis)}"


def _error(diagnosis: Diagnosis) -> str:
    value = diagnosis.after.prediction_rmse_mm
    return f"{wording.fixed(value, 1)} mm" if math.isfinite(value) else wording.NONE
