"""Describes effects in everyday words: a short name, and a sentence with numbers for any reader.

The words are those of the effect's class. An effect without words, such as a user's own, gets its name with spaces and
its own `sentence`.
"""

from typing import Final

from ballfg.diagnosis.report.wording import capital, listed, plus_minus
from ballfg.diagnosis.result import Finding
from ballfg.dynamics import EFFECTS
from ballfg.dynamics.wording import said

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
