"""A goal of a design is to separate two effects, as a diagnosis asks, or to shrink the error bar of a coefficient."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ballfg.checks import did_you_mean, one_line, short_text
from ballfg.diagnosis.evidence.weighed import weigh
from ballfg.diagnosis.fit.effects import has_effect
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.hypotheses.hypothesis import TWINS, Hypothesis, hypotheses, scene_of
from ballfg.diagnosis.report.report import REPORT
from ballfg.diagnosis.result import Diagnosis
from ballfg.diagnosis.search.trial import score_all
from ballfg.dynamics import EFFECTS
from ballfg.files.json_file import read_json


@dataclass(frozen=True)
class Goal:
    """Effects with unknown strengths beside the model's, and sides of parameters that should be known well, by name.

    Each side is to be known with all else unknown: two sides for effects to separate, one for a coefficient.
    """

    hypotheses: tuple[Hypothesis, ...]
    sides: tuple[tuple[str, ...], ...]

    @property
    def names(self) -> tuple[str, ...]:
        """All parameter names, each once."""
        return tuple(dict.fromkeys(name for side in self.sides for name in side))


def separating(fit: Fit, pairs: Sequence[tuple[str, str]]) -> Goal:
    """The goal to separate pairs of effects (`frame_tilt`) or strengths (`wind.x`); fit: of the declared model.

    Raises: ValueError: an unknown effect or coefficient, one that cannot act in these data, or one named twice.
    """
    found = {text: hypothesis_of(fit, text) for pair in pairs for text in pair}
    for one, other in pairs:
        if set(found[one].columns) & set(found[other].columns):
            raise ValueError(f"between must name two different effects; got {one},{other}. Name another one.")
    return Goal(tuple(found.values()), tuple(found[text].columns for pair in pairs for text in pair))


def shrinking(fit: Fit, text: str) -> Goal:
    """The goal to shrink the error bar of a coefficient, such as `drag.k`, or those of an effect.

    A coefficient that the fit of the declared model estimates keeps its prior.

    Raises: ValueError: as `separating`.
    """
    hypothesis = hypothesis_of(fit, text)
    declared = all(name in fit.problem.free for name in hypothesis.columns)
    return Goal(() if declared else (hypothesis,), (hypothesis.columns,))


def hypothesis_of(fit: Fit, text: str) -> Hypothesis:
    """The effect in a text (`wind`, or one strength of it, `wind.x`), in the shape that explains most."""
    name, _, strength = text.strip().partition(".")
    if name not in EFFECTS:
        raise ValueError(f"effect '{name}' is not known.{did_you_mean(name, EFFECTS)} See ballfg info.")
    effect, model = EFFECTS[name], fit.problem.model
    if has_effect(model, name):
        found = Hypothesis(effect, {}, tuple(c.name for c in effect.coefficients if c.absent is not None))
    else:
        possible = [h for h in hypotheses(model, scene_of(fit), [effect]) if h.strengths]
        if not possible:
            needs = f" It needs {', '.join(effect.needs)} in the model." if effect.needs else ""
            raise ValueError(f"effect '{name}' cannot act in these tracks.{needs} Name another one.")
        found = possible[0] if len(possible) == 1 else score_all(weigh(fit), possible)[0].hypothesis
    if not strength:
        return found
    if strength not in found.strengths:
        raise ValueError(
            f"effect '{name}' has the strengths {', '.join(found.strengths)}; got '{strength}'. Rename it."
        )
    return replace(found, strengths=(strength,))


def pairs_of(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """Pairs of a diagnosis: an added effect and one that would have explained as much.

    Raises: ValueError: if there is no such pair.
    """
    return _pairs({f.name: f.indistinguishable_from for f in diagnosis.findings}, "the diagnosis")


def reported_pairs(folder: Path) -> list[tuple[str, str]]:
    """Pairs of a diagnosis in a folder.

    Raises: FileNotFoundError: no report there. ValueError: a file that is no report, or no pair in it.
    """
    path = folder / REPORT
    if not path.is_file():
        raise FileNotFoundError(f"diagnosis must be a folder with {REPORT}; {folder} has none. Run ballfg diagnose.")
    try:
        effects = read_json(path)["effects"]
        found = {str(e["name"]): [str(name) for name in e["indistinguishable_from"]] for e in effects}
    except (ValueError, KeyError, TypeError) as error:
        said = short_text(one_line(error))
        raise ValueError(f"{path} is not the report of a diagnosis ({said}). Run ballfg diagnose again.") from None
    return _pairs(found, str(path))


def _pairs(alike: Mapping[str, Sequence[str]], where: str) -> list[tuple[str, str]]:
    """Pairs of registered effects, without twins, which no shot separates."""
    pairs = [
        (name, other)
        for name, others in alike.items()
        for other in others
        if name in EFFECTS and other in EFFECTS and other not in TWINS.get(name, ())
    ]
    if not pairs:
        raise ValueError(
            f"{where} names no pair of effects that it could not tell apart. Say what the shots are for with --between "
            "or --shrink."
        )
    return pairs
