"""Explains the words of a report, on hover and in a list at the end of the page."""

from typing import Final

from ballfg.diagnosis.result import Outcome
from ballfg.pages.html import Html, explained, meanings

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
