"""Diagnoses strokes that one camera saw, from their pixels."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Final

import numpy as np

from ballfg.checks import check_range
from ballfg.diagnosis.fit.effects import has_effect, with_coefficients, with_effects
from ballfg.diagnosis.fit.holdout import analytic
from ballfg.diagnosis.generic_test import ALARM, GenericTest
from ballfg.diagnosis.hypotheses.hypothesis import TWINS, Hypothesis
from ballfg.diagnosis.one_view.picture import ERRORS, Picture
from ballfg.diagnosis.one_view.search import Found, search
from ballfg.diagnosis.one_view.strokes import share_of
from ballfg.diagnosis.one_view.weights import Set
from ballfg.diagnosis.report.wording import sentence
from ballfg.diagnosis.result import (
    ContactResiduals,
    Diagnosis,
    Errors,
    Finding,
    FlightResiduals,
    MeasurementResiduals,
    Residuals,
    Unexplained,
    Value,
    Verdict,
)
from ballfg.diagnosis.search.loop import NAMED
from ballfg.diagnosis.search.ranking import ranking, unusual
from ballfg.diagnosis.search.score import Scored
from ballfg.dynamics import EFFECTS, AnalyticModel, BallModel, Surfaces
from ballfg.dynamics.effect import Effect
from ballfg.estimation import Settings, Smoother, dataset_settings, dataset_surfaces
from ballfg.estimation.batch import map_tracks
from ballfg.estimation.noise.estimate import spread_over
from ballfg.estimation.observations.sighted_dataset import SightedDataset
from ballfg.learning.evaluation import TrackScore, judge_track, summary
from ballfg.state import STATE_DIM
from ballfg.tracks.track import Track

MOST_STROKES: Final = 100  # Evenly over the dataset: each is filmed again some twenty times a round
OBSERVED: Final = 0.4  # Share of a stroke that is observed, as in a diagnosis of positions
EVALUATION: Final = (
    "Each of {count} strokes was observed over the first 40 % of its duration and predicted over the rest. Errors are "
    "those across the rays of the later sightings: nobody measured how far away the ball was. All strokes were used to "
    "find effects and to fit the model, since half of them would show only larger ones; the few strengths that are "
    "fitted hardly follow single strokes."
)


def diagnose_one_view(
    dataset: SightedDataset,
    model: BallModel,
    *,
    jobs: int = 1,
    watch: Callable[[str], None] | None = None,
    catalogue: Sequence[type[Effect]] | None = None,
    name_at: float = NAMED,
) -> Diagnosis:
    """Find what the ball's laws, clock or lens lack from the strokes that one camera saw.

    Args: dataset: the strokes, each with a bounce in the picture.  The others: as for `diagnose`.
    Raises:
        TypeError: if the model is a learned one.
        ValueError: several cameras, or too few strokes whose place is known well.
    """
    check_range("name_at", name_at, 0.0, 1.0)
    if not dataset.one_view:
        raise ValueError(
            f"{dataset.path}: a diagnosis of sightings is for one camera; several show positions. Make tracks with "
            "'ballfg track', and diagnose those."
        )
    declared, tell = analytic(model), watch or (lambda line: None)
    tracks = list(spread_over(iter(dataset), len(dataset), MOST_STROKES))
    surfaces, settings = dataset_surfaces(dataset), dataset_settings(dataset, declared)
    effects = tuple(catalogue or EFFECTS.values())
    found = search(tracks, declared, surfaces, settings, effects, tell, jobs)
    tell("predicting the rest of each stroke")
    predicted = partial(errors_across, tracks=tracks, surfaces=surfaces, settings=settings, jobs=jobs)
    return told(found, declared, tracks, dataset.info.name, predicted, name_at)


def told(
    found: Found,
    declared: AnalyticModel,
    tracks: Sequence[Track],
    name: str,
    predicted: Callable[[AnalyticModel, Picture], Errors],
    name_at: float,
) -> Diagnosis:
    """The diagnosis that a search leads to.

    Args: tracks: all that were looked at.  name: of the dataset.  predicted: errors of a model with a camera's errors.
    """
    named = _named(found, name_at)
    plain, best, fitted = found.weights.weighed(()), found.weights.weighed(named), found.weights.fitted(named)
    before, after = with_values(declared, found.first), _model(declared, fitted, named)
    was = predicted(before, Picture())
    now = predicted(after, Picture.of(fitted.strengths)) if named else was
    left, findings = _left(found, plain, best), tuple(_finding(found, one, best, fitted) for one in named)
    verdict = Verdict.FOUND if findings else Verdict.NOTHING
    if left.tests[0].p_value < ALARM:
        verdict = Verdict.UNEXPLAINED
    odds, count = found.odds, len(found.strokes)
    scores = [(h, found.weights.score(h)) for h in found.weights.hypotheses]
    tests = len(scores)
    scored = [Scored(h, score, min(1.0, tests * score.p_value), tested=tests) for h, score in scores]
    rows = ranking(sorted(scored, key=lambda s: -s.explained), (), [h.name for h in named], odds)
    return Diagnosis(
        dataset=name,
        verdict=verdict,
        sentence=sentence(verdict, findings, left),
        findings=findings,
        rounds=(rows,),
        before=was,
        after=now,
        tracks_found_on=count,
        tracks_judged_on=len(was.by_track),
        calibrated=_calibrated(found.with_lift, declared),
        noise={},
        unexplained=left,
        model=after,
        residuals_before=NONE,
        residuals_after=NONE,
        excluded=_excluded(found, tracks),
        remarks=_remarks(found, named),
        probabilities=odds.effects(),
        nothing_lacking=odds.nothing,
        evaluation=EVALUATION.format(count=len(was.by_track)),
    )


def _named(found: Found, name_at: float) -> list[Hypothesis]:
    """Effects of the most probable set that are there, they or one that cannot be told from them, probably enough."""
    names, odds = found.best.names, found.odds
    chosen = [h for h in found.weights.hypotheses if h.name in names]
    return [h for h in chosen if odds.together(h.name, names) >= name_at]


def _model(declared: AnalyticModel, one: Set, named: Sequence[Hypothesis]) -> AnalyticModel:
    """The declared model with a set's values, and with the effects of those named that act on the ball."""
    values, sigmas = one.strengths, dict(zip(one.unknown, one.sigmas.tolist(), strict=True))
    added = []
    for hypothesis in named:
        names = dict(zip(hypothesis.strengths, hypothesis.columns, strict=True))
        if hypothesis.effect not in ERRORS and not has_effect(declared, hypothesis.name):
            effect = hypothesis.effect(**{**hypothesis.shape, **{name: values[full] for name, full in names.items()}})
            effect.set_sigmas(**{name: sigmas[full] for name, full in names.items()})
            added.append(effect)
    return with_values(declared, values, added)


def with_values(declared: AnalyticModel, values: Mapping[str, float], added: Sequence[Effect] = ()) -> AnalyticModel:
    """The declared model with further effects and other values; its noise, domain and variations stay."""
    model = with_coefficients(with_effects(declared, *added), values)
    model.noise, model.domain, model.variations = declared.noise, declared.domain, dict(declared.variations)
    return model


def errors_across(
    model: AnalyticModel,
    picture: Picture,
    *,
    tracks: Sequence[Track],
    surfaces: Surfaces,
    settings: Settings,
    jobs: int,
) -> Errors:
    """Errors of predictions across the rays, by a camera whose errors are known."""
    judge = partial(_judged, Smoother(model, surfaces, settings), picture, model, surfaces)
    scores = [score for score in map_tracks(judge, tracks, len(tracks), jobs) if score is not None]
    whole, nan = summary(scores), float("nan")
    if whole is None:
        return Errors(nan, nan, nan, nan, np.zeros(0))
    return Errors(
        prediction_rmse_mm=1e3 * whole.rmse_pooled,
        apex_rmse_mm=nan,
        nis=whole.prediction_nis / 3.0,
        log_likelihood=float(np.average([s.log_score for s in scores], weights=[s.samples for s in scores])),
        by_track=1e3 * np.array([score.rmse for score in scores]),
        intervals_held=whole.coverage_90,
    )


def _judged(
    smoother: Smoother, picture: Picture, model: AnalyticModel, surfaces: Surfaces, track: Track
) -> TrackScore | None:
    return judge_track(smoother, picture.seen_by(track, model, surfaces), OBSERVED, np.inf)


def _finding(found: Found, one: Hypothesis, best: Set, fitted: Set) -> Finding:
    """A named effect with its evidence, and its strengths as they were fitted."""
    weights, odds = found.weights, found.odds
    places = [fitted.unknown.index(column) for column in one.columns]
    values = {
        name: Value(float(fitted.values[place]), float(fitted.sigmas[place]), one.coefficients[name].unit)
        for name, place in zip(one.strengths, places, strict=True)
    }
    rest = weights.weighed([h for h in weights.hypotheses if h.name in best.names - {one.name}])
    score, evidence, nan = weights.score(one), best.evidence - rest.evidence, float("nan")
    return Finding(
        name=one.name,
        kind=one.effect.kind,
        parameters={**values, **{name: Value(v, 0.0, one.coefficients[name].unit) for name, v in one.shape.items()}},
        p_value=min(1.0, score.p_value * len(weights.hypotheses)),
        delta_bic=-2.0 * evidence,
        indistinguishable_from=(*TWINS.get(one.name, ()), *odds.alike(one.name, found.best.names)),
        held_out_gain=nan,
        held_out_p=nan,
        sentence=one.effect.sentence,
        decide=one.effect.decide,
        probability=odds.of(one.name),
        together=odds.together(one.name, found.best.names),
        evidence=evidence,
        usual=unusual(one, values),
    )


def _left(found: Found, plain: Set, best: Set) -> Unexplained:
    """The test for whether the strokes, filmed again by the corrected laws, pull them as the real ones do."""
    p_value, share = found.weights.by_chance(best), min(1.0, best.misfit / max(plain.misfit, 1e-12))
    words = "the sightings pull the laws away from strokes filmed again, by more than chance"
    test = GenericTest("sightings", words, p_value, share)
    return Unexplained(words if p_value < ALARM else "", share, (test,), None)


def _calibrated(one: Set, declared: AnalyticModel) -> Mapping[str, Value]:
    """The coefficients of a set, as its strokes show them together."""
    given, units = dict(declared.named_parameters()), declared.declared_coefficients()
    values = zip(one.unknown, one.values.tolist(), one.sigmas.tolist(), strict=True)
    return {n: Value(value, sigma, units[n].unit, float(given[n].detach())) for n, value, sigma in values}


def _excluded(found: Found, tracks: Sequence[Track]) -> tuple[str, ...]:
    used = {stroke.track.name for stroke in found.strokes}
    lost = [track.name for track in tracks if track.name not in used]
    return tuple(f"{name}: its sightings do not show well how far away it was" for name in lost)


def _remarks(found: Found, named: Sequence[Hypothesis]) -> tuple[str, ...]:
    """Sentences on what the corrected model cannot hold, on the scatter, and on what was not looked for."""
    words = []
    if lens := [h.name for h in named if h.effect in ERRORS]:
        words.append(
            f"model.yaml does not hold {' and '.join(lens)}: it describes the ball and the room. Correct cameras.yaml "
            "or the stamps. The predictions of the corrected model were made with both corrected."
        )
    share = share_of(found.laws.settings)
    words.append(f"Flights and bounces scatter about the laws by {share:g} of what is usual for one camera's strokes.")
    words.append(
        "One camera was asked about the ball's laws, the table and the room, its clock, its focal length and its lens, "
        "not about effects of one place, of labels or of positions."
    )
    return tuple(words)


def _nothing() -> Residuals:
    """No residuals: one camera measures no positions."""
    none, numbers = np.zeros(0), np.zeros(0, dtype=np.int64)
    states, three = np.zeros((0, STATE_DIM)), np.zeros((0, 3))
    flight = FlightResiduals(numbers, none, states, three, np.zeros((0, 3, 3)))
    contact = ContactResiduals(numbers, numbers, none, states, three, three, np.zeros((0, 6, 6)))
    return Residuals((), flight, contact, MeasurementResiduals(numbers, none, states, none, three, three))


NONE: Final = _nothing()
