"""Holds the result of a diagnosis: verdict, added effects with evidence, errors before and after, the rest."""

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ballfg.arrays import Array, Index
from ballfg.diagnosis.budget import ErrorBudget
from ballfg.diagnosis.generic_test import GenericTest, LabelCheck
from ballfg.dynamics import BallModel

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Verdict(enum.Enum):
    """The answer of a diagnosis: whether the model lacks anything."""

    FOUND = "effect found"
    NOTHING = "nothing lacking"
    UNEXPLAINED = "unexplained"


class Outcome(enum.Enum):
    """The outcome of a round for one of its candidates."""

    ADDED = "added"
    ALIKE = "cannot be told from the one added"
    WEAKER = "explains less"
    NOT_NEEDED = "not needed"
    INVISIBLE = "cannot be seen in these data"


@dataclass(frozen=True)
class Value:
    """A number with its standard deviation and unit. `declared`: the model's value before the fit, if it had one."""

    value: float
    sigma: float
    unit: str
    declared: float | None = None


@dataclass(frozen=True)
class Finding:
    """An effect that was added to the model, of the kind `flight`, `bounce` or `measurement`.

    Attributes:
        parameters: its coefficients fitted to the tracks of both halves, at the end of the search.
        p_value: of its score test, corrected for the number of candidates tested.
        delta_bic: minus twice `evidence`, which BIC approximates; negative is better.
        indistinguishable_from: candidates that would have explained as much.
        held_out_gain: increase of the log likelihood per track on the held-out half, natural units.
        held_out_p: probability of such a gain there by chance.
        sentence, decide: what the effect is, and the measurement that tells it from others.
        probability: that the effect is there, over all models that were compared.
        together: probability that it or one of `indistinguishable_from` is there.
        evidence: logarithm of the density of the tracks with it over that without it, natural units.
        usual: words on a strength outside of the usual range; empty inside.
    """

    name: str
    kind: str
    parameters: Mapping[str, Value]
    p_value: float
    delta_bic: float
    indistinguishable_from: tuple[str, ...]
    held_out_gain: float
    held_out_p: float
    sentence: str
    decide: str
    probability: float = 1.0
    evidence: float = float("nan")
    usual: str = ""
    together: float = 1.0


@dataclass(frozen=True)
class Candidate:
    """One row of a round's ranking.

    Attributes:
        estimate: the effect's coefficients after one step from absent.
        explained: squared whitened residual that it would explain.
        p_value: of its score test, corrected for the number of candidates.
        delta_bic: after a few steps of a refit; None if the score was too low for one.
        outcome: of the round.
        seen_from: coefficient -> size, in its unit, that the score test would have detected in 9 of 10 such recordings,
            whatever the other coefficients are; empty if nothing shows it.
        probability: that the effect is there, over all models that were compared in the whole search.
    """

    name: str
    kind: str
    estimate: Mapping[str, Value]
    explained: float
    p_value: float
    delta_bic: float | None
    outcome: Outcome
    seen_from: Mapping[str, float] = field(default_factory=dict)
    probability: float = 0.0


@dataclass(frozen=True)
class PredictedPath:
    """The prediction of one held-out track, for pictures.

    Attributes:
        seen: (m, 3) m, measured positions of the observed part.
        times: (k,) s since the end of the observed part, of the predicted samples.
        predicted, measured: (k, 3) m at these times.
    """

    name: str
    seen: Array
    times: Array
    predicted: Array
    measured: Array


@dataclass(frozen=True)
class Errors:
    """Prediction errors on the held-out half: the first 40 % of each track observed, the rest predicted.

    Attributes:
        prediction_rmse_mm: root mean square distance of predicted from measured positions.
        apex_rmse_mm: the same for the highest points of flights that begin after the observed part; NaN without any.
        nis: mean squared whitened prediction error per coordinate; 1 for a calibrated prediction.
        log_likelihood: mean log density of a measured coordinate under its prediction.
        by_track: (t,) mm, root mean square distance of each track.
        intervals_held: share of measured coordinates inside their central 90 % intervals, 0 to 1.
        nis_median: median over samples of the squared whitened errors of x, y and z added; 2.37 is right.
        paths: the predictions themselves, in the order of `by_track`.
        nis_error: standard error of `nis`, from the scatter of tracks; NaN for a single one.
    """

    prediction_rmse_mm: float
    apex_rmse_mm: float
    nis: float
    log_likelihood: float
    by_track: Array
    intervals_held: float = float("nan")
    nis_median: float = float("nan")
    paths: tuple[PredictedPath, ...] = ()
    nis_error: float = float("nan")


@dataclass(frozen=True)
class Fallback:
    """A description of the remaining pattern without a name, in words; its kind is `sparse terms`.

    Attributes:
        before, after: errors on the held-out half without and with it, named effects in both.
        model: the model with it.
    """

    kind: str
    description: str
    before: Errors
    after: Errors
    model: BallModel


@dataclass(frozen=True)
class Unexplained:
    """The remaining pattern at the end, with all generic tests and the fallback, if one was needed and helped.

    Attributes:
        where: one sentence; empty without a remaining pattern.
        share_of_residual: remaining part of the initial pattern, 0 to 1.
    """

    where: str
    share_of_residual: float
    tests: tuple[GenericTest, ...]
    fallback: Fallback | None


@dataclass(frozen=True)
class FlightResiduals:
    """Unmodelled accelerations (m, 3) m/s^2 in flight and their covariances, one for each bin of time of each stretch.

    Attributes:
        stretch, times: (m,) number of the stretch, and s since its first sample.
        states: (m, 9) at these times.
    """

    stretch: Index
    times: Array
    states: Array
    acceleration: Array
    covariance: Array


@dataclass(frozen=True)
class ContactResiduals:
    """Outgoing minus predicted motion at each contact.

    Attributes:
        stretch, number, times: (m,) of the stretch, of the contact in it, and s since the stretch's first sample.
        incoming: (m, 9) state before it.
        velocity, spin: (m, 3) m/s and (m, 3) rad/s.
        covariance: (m, 6, 6) of both.
    """

    stretch: Index
    number: Index
    times: Array
    incoming: Array
    velocity: Array
    spin: Array
    covariance: Array


@dataclass(frozen=True)
class MeasurementResiduals:
    """Measured minus fitted positions (m, 3) m, and their noise.

    Attributes:
        stretch, times: (m,) number of the stretch, and s since its first sample.
        states: (m, 9) at these times.
        since_contact: (m,) s since the last contact, NaN before the first one.
    """

    stretch: Index
    times: Array
    states: Array
    since_contact: Array
    position: Array
    sigma: Array


@dataclass(frozen=True)
class Residuals:
    """Residuals of a fit in three kinds; `names` (n,) of the track of each stretch."""

    names: tuple[str, ...]
    flight: FlightResiduals
    contact: ContactResiduals
    measurement: MeasurementResiduals


@dataclass(frozen=True)
class Diagnosis:
    """The result of a diagnosis.

    Attributes:
        verdict, sentence: the answer, and the answer in one sentence with numbers.
        findings: effects in the order added.
        rounds: the ranking of all candidates in each round, best first.
        before: errors on the held-out half with the declared model as calibrated, beside the population of its spins.
        after: the same with the corrected model: named effects, and the fallback where there is one.
        unpopulated: as `before`, with the prior of any spin; None for several datasets.
        tracks_found_on, tracks_judged_on: numbers of tracks of the search half and of the held-out half.
        calibrated: declared coefficients fitted with the corrected model to the tracks of both halves.
        noise: position noise along x, y, z as estimated (m), and as stated.
        model: the corrected model. It is fitted to the tracks of both halves after its evaluation, unless the search
            half fitted it to predictions or gave it a fallback.
        residuals_before, residuals_after: of the search half with the declared and with the corrected model.
        excluded: sentences on unused tracks.
        remarks: sentences on implausible values, differences between tracks, coefficients that predictions moved.
        floor_mm: prediction error of the held-out tracks for an exact corrected model, from measurement noise and the
            unknown release alone: `budget.exact`; NaN if unknown.
        labels: verdicts on the spin labels; None without labels.
        probabilities: that an effect is there, by name, over all models that were compared; the most probable first.
        nothing_lacking: probability that nothing is lacking, neither an effect of the catalogue nor something nameless.
        budget: parts of the prediction error; None for several datasets, or if the model sees a hit in each track.
        nameless: probability that forces, kicks or position errors remain that no effect of the catalogue describes;
            NaN from one camera.
        evaluation: how it was evaluated, in words; empty for the usual way, by the held-out half.
    """

    dataset: str
    verdict: Verdict
    sentence: str
    findings: tuple[Finding, ...]
    rounds: tuple[tuple[Candidate, ...], ...]
    before: Errors
    after: Errors
    tracks_found_on: int
    tracks_judged_on: int
    calibrated: Mapping[str, Value]
    noise: Mapping[str, Value]
    unexplained: Unexplained
    model: BallModel
    residuals_before: Residuals
    residuals_after: Residuals
    excluded: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    floor_mm: float = float("nan")
    labels: LabelCheck | None = None
    probabilities: Mapping[str, float] = field(default_factory=dict)
    nothing_lacking: float = float("nan")
    nameless: float = float("nan")
    budget: ErrorBudget | None = None
    unpopulated: Errors | None = None
    evaluation: str = ""

    def __repr__(self) -> str:
        effects = ", ".join(finding.name for finding in self.findings) or "none"
        return f"Diagnosis({self.dataset!r}, effects added: {effects};\n    {self.sentence})"

    def plot(self) -> "Figure":
        """A picture of the prediction error of each held-out track, before and after the model was corrected.

        If nothing was added to the model, it shows the residuals of the fitted model over their normal distribution.
        """
        from ballfg.diagnosis.report import pictures

        if self.findings:
            return pictures.errors_by_track(self.before, self.after)
        return pictures.histogram({"the fitted model": self.residuals_before})
