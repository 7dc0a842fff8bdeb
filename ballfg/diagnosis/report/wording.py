"""Writes effects, numbers with known digits and units, and the answer in one sentence in words for people.

The words of an effect are those of its class; one without words gets its name with spaces and its own `sentence`.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Final

from ballfg.diagnosis.result import Finding, Outcome, Unexplained, Value, Verdict
from ballfg.dynamics import EFFECTS
from ballfg.dynamics.wording import said
from ballfg.estimation.noise.tracker_errors import NUMBERS
from ballfg.pages.html import Html, explained, meanings

NONE = "–"  # Text for a missing number
MOST_DECIMALS = 6  # Largest number of decimals; others are written with a power of ten
MOST_CERTAIN = 0.999  # Larger probabilities of an effect depend on what no catalogue holds
LEAST_PROBABILITY = 1e-99  # Smaller probabilities depend on unknown tails of distributions


def number(value: float, digits: int = 3) -> str:
    """A number to some significant digits; a dash for NaN."""
    return NONE if math.isnan(value) else f"{value:.{digits}g}"


def fixed(value: float, decimals: int) -> str:
    """A number to some decimals; a dash for NaN."""
    return NONE if math.isnan(value) else f"{value:.{decimals}f}"


def plus_minus(value: Value) -> str:
    """For instance `0.203 ± 0.012 m/s`: two digits of the standard deviation and the value's to the same decimal."""
    unit = "" if value.unit == "1" else f" {value.unit}"
    if not (math.isfinite(value.sigma) and value.sigma > 0):
        return f"{number(value.value, 4)}{unit}"
    decimals = max(0, 1 - math.floor(math.log10(value.sigma)))
    if decimals > MOST_DECIMALS:
        return f"{value.value:.3g} ± {value.sigma:.2g}{unit}"
    shown = f"{value.value:.{decimals}f}"
    return f"{shown.removeprefix('-') if float(shown) == 0.0 else shown} ± {value.sigma:.{decimals}f}{unit}"


def sized(size: float, unit: str) -> str:
    """A size to two digits with its unit, without the unit `1`; a dash if it is not finite."""
    if not math.isfinite(size):
        return NONE
    return number(size, 2) if unit == "1" else f"{number(size, 2)} {unit}"


def listed(values: Mapping[str, Value]) -> str:
    """For instance `x 0.203 ± 0.012 m/s, y 0.001 ± 0.010 m/s`."""
    return ", ".join(f"{name} {plus_minus(value)}" for name, value in values.items())


def probability(p: float) -> str:
    """For instance `0.34`, `3e-12`, `less than 1e-99`; a dash for NaN."""
    if math.isnan(p):
        return NONE
    if p < LEAST_PROBABILITY:
        return f"less than {LEAST_PROBABILITY:.0e}"
    return f"{p:.2g}" if p >= 1e-3 else f"{p:.0e}".replace("e-0", "e-")


def odds(p: float) -> str:
    """The probability of an effect, for instance `97.2 %`; never as certain as 0 or 100 %."""
    if p > MOST_CERTAIN:
        return f"> {100 * MOST_CERTAIN:g} %"
    return f"< {100 * (1.0 - MOST_CERTAIN):.1f} %" if p < 1.0 - MOST_CERTAIN else f"{100 * p:.1f} %"


def change(before: float, after: float) -> str:
    """For instance `-34 %`; empty without a comparison."""
    if not (math.isfinite(before) and math.isfinite(after)) or before == 0.0:
        return ""
    return f"{100 * (after / before - 1):+.0f} %"


def joined(names: tuple[str, ...]) -> str:
    """For instance `wind, gust_region and drag_speed`."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}" if names else ""


def sentence(verdict: Verdict, findings: Sequence[Finding], left: Unexplained) -> str:
    """The answer of a diagnosis in one sentence, with a second one on the tracker's noise."""
    if verdict is Verdict.NOTHING:
        return "Nothing is lacking that these tracks could show: what the model leaves is noise."
    effects = [f for f in findings if f.name not in NUMBERS]
    tracker = [f for f in findings if f.name in NUMBERS]
    shown = f"The measurements show {_named(tracker)}" if tracker else ""
    if verdict is Verdict.FOUND and not effects:
        return f"{shown}; no effect is lacking, and what is left is noise."
    if verdict is Verdict.FOUND:
        answer = (
            f"The model lacks {_named(effects)}; with {'it' if len(effects) == 1 else 'them'} what is left is noise."
        )
    elif not effects:
        answer = f"Something is lacking that no effect of the catalogue explains: {left.where}."
    else:
        share = f"{100 * left.share_of_residual:.0f} % of a pattern stays unexplained: {left.where}."
        answer = f"Something is lacking: {_named(effects)} would explain a part; {share}"
    return f"{answer} {shown}." if shown else answer


def _named(findings: Sequence[Finding]) -> str:
    return joined(
        tuple(f"{' or '.join((f.name, *f.indistinguishable_from))} ({listed(f.parameters)})" for f in findings)
    )


def capital(words: str) -> str:
    """The same words as the start of a sentence: with a capital first letter."""
    return words[:1].upper() + words[1:]


BY_GROUP, DRIFT = "_by_group", "_drift"
"""Suffixes of the names of effects that differ between groups of tracks, or change along the recording."""
OF_A_TRACKER: Final = {
    "tracker_memory": (
        "a tracker whose errors last",
        "The tracker's errors last from sample to sample: {sigma:milli} mm that fade over {time:milli} ms.",
    ),
    "stamp_jitter": ("time stamps that jitter", "The time stamps jitter by {sigma:milli} ms from sample to sample."),
}
"""Findings of a diagnosis other than effects: as a noun and in a sentence."""


def plain_name(effect: str) -> str:
    """An effect as a noun: `a wind`; for an unknown effect its name with spaces."""
    for ending, words in ((BY_GROUP, "different from group to group"), (DRIFT, "changing along the recording")):
        if effect.endswith(ending):
            return f"{plain_name(effect.removesuffix(ending))}, {words}"
    return _words(effect)[0] or effect.replace("_", " ")


def in_plain_words(finding: Finding) -> str:
    """A sentence on an effect and its size. For an unknown effect: its own first sentence and its coefficients."""
    if says := _words(finding.name)[1]:
        return said(says, finding.parameters)
    for ending, words in ((BY_GROUP, "differs between groups of tracks"), (DRIFT, "changes along the recording")):
        if finding.name.endswith(ending):
            whole = plain_name(finding.name.removesuffix(ending))
            levels = (f"{_level(name)} {plus_minus(value)}" for name, value in finding.parameters.items())
            return f"{capital(whole)} {words}: {', '.join(levels)}."
    first = finding.sentence.partition(". ")[0].rstrip(".")
    return f"{first} ({listed(finding.parameters)})." if finding.parameters else f"{first}."


def _words(effect: str) -> tuple[str, str]:
    """Noun and sentence of an effect; empty without any."""
    if effect in OF_A_TRACKER:
        return OF_A_TRACKER[effect]
    known = EFFECTS.get(effect)
    return ("", "") if known is None else (known.plain, known.says)


def _level(name: str) -> str:
    """`topspin` for `k[topspin]`; with the axis of a vector's coefficient: `topspin x`."""
    coefficient, _, level = name.partition("[")
    return f"{level.removesuffix(']')} {coefficient}" if coefficient in ("x", "y", "z") else level.removesuffix("]")


TERMS: Final = {
    "prediction error": "Distance between a predicted and a measured position, in mm: the root mean square (RMSE) over "
    "all predicted samples, so that large errors weigh more.",
    "held-out tracks": "Every second track. The corrected model is not fitted to them while it is judged: their "
    "predictions show what the model does for new tracks.",
    "apex": "The highest point of a flight.",
    "NIS": "Normalised innovation squared: squared prediction error over the variance that the prediction states. 1 on "
    "average is right; above 1 the stated uncertainty is too small, below 1 it is too large.",
    "90 % intervals": "Ranges that should hold 90 of 100 measured coordinates. Fewer: predictions claim to be better "
    "than they are. More: they are too cautious.",
    "log likelihood": "How probable the measurements are under the predictions, as a logarithm per coordinate; larger "
    "is better. It judges the error and the stated uncertainty together.",
    "by chance": "Probability that noise alone gives a trace as strong as this one (p-value), corrected for the number "
    "of effects tested. Below 0.0025 an effect is a candidate, and is added if it passes the other questions too. Very "
    "small numbers say: certainly not chance.",
    "BIC": "Bayesian information criterion: badness of fit plus a penalty for each further coefficient. An effect pays "
    "for itself where the BIC falls; by 10 is strong evidence.",
    "coefficient": "A number of the model, such as the strength of the drag. After ± stands one standard deviation: "
    "the true value lies within two of them in 95 of 100 cases.",
    "first estimate": "Coefficients one step from the model of the round. Where the model has the coefficient already, "
    "as gravity or the drag of a group, it is the change of it.",
    "floor": "The prediction error of a model that is exact, foretold from its covariance: the noise of the "
    "measurements and what the observed part leaves open of speed and spin at the release.",
    "error budget": "The prediction error in parts whose squares add up: what each source of noise and random motion "
    "adds to predictions, what the named effects took away, and what is left.",
    "trace": "The pattern in the residuals that an effect would leave.",
    "residual": "Measured minus predicted.",
    "squared residual": "Squared residuals in units of their noise, summed. Under independent errors chance explains "
    "about 1 for each coefficient; errors of one track go together, which the probability beside it allows for.",
    "stretch": "The part of a track between two hits by a player or launcher.",
    "round": "One pass of the search: all effects are tested, and at most one is added to the model.",
    "generic test": "A test for a pattern of any cause: by place, speed, spin, time or order in the recording.",
}
"""Words of the report that a newcomer may not know."""
OUTCOMES: Final = {
    Outcome.ADDED: "It was added to the model.",
    Outcome.ALIKE: "It explains these tracks as well as the one added: they cannot tell the two apart.",
    Outcome.WEAKER: "Another effect explains more of the same residuals and was added in its place.",
    Outcome.NOT_NEEDED: "With the model of this round nothing asks for it any more: what it would explain, the effects "
    "that were added explain, or chance.",
    Outcome.INVISIBLE: "Nothing in these tracks depends on it, so they neither show it nor rule it out.",
}
"""Meaning of each outcome of a candidate."""


def term(name: str, shown: str = "") -> Html:
    """A word with its explanation on hover; shown: another form of it."""
    return explained(shown or name, TERMS[name])


def glossary() -> Html:
    """All words with their explanations."""
    return meanings(TERMS | {f"“{outcome.value}”": meaning for outcome, meaning in OUTCOMES.items()})
