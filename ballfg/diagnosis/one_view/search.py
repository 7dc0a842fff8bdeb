"""Looks for what the laws lack in the strokes of one camera.

All sets of effects are weighed about laws without any. The likeliest are then followed one by one, each until it is
found where it has moved the laws: a strength that is far off is not seen in one linear step.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, cast

import numpy as np

from ballfg.arrays import Array
from ballfg.diagnosis.evidence.odds import Odds
from ballfg.diagnosis.evidence.prior import centres, scales
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis, hypotheses
from ballfg.diagnosis.one_view.picture import ERRORS, NAMES
from ballfg.diagnosis.one_view.strokes import Laws, Stroke, all_estimated, scores_again, with_likeliest_noise
from ballfg.diagnosis.one_view.weights import Set, Weights, mean_of, odds_of, slopes_of
from ballfg.dynamics import AnalyticModel, Surfaces
from ballfg.dynamics.effect import Effect, Scene, Vector
from ballfg.estimation import Settings
from ballfg.state import POSITION, VELOCITY
from ballfg.tracks.track import Track

LEAST: Final = 20  # Strokes. With fewer, the scatter of as many scores from stroke to stroke is hardly known
REPEATS: Final = 3  # Times that each stroke is filmed again with the laws of today
ROUNDS: Final = 4
FOLLOWED, FOLLOWED_FROM, WORSE = 3, 12.0, 2.0
"""Largest number of effects that are followed; logarithms of odds by which the best set that holds one may fall short
of the most probable one, and of none, about laws without any."""
MOST_STEPS: Final = 12  # Rounds of the most probable set: each takes strengths about half of the way that is left
SETTLED: Final = 0.25  # Standard deviations by which a strength of the last round may have moved
SEED: Final = 20_000
LIFT: Final = "flight.magnus.k"
CLOCKS: Final = ("gravity", "buoyancy")
"""Effects that do what a clock does that runs wrong: g is known to a thousandth, a frame rate often is not."""


@dataclass(frozen=True)
class Found:
    """The end of a search."""

    laws: Laws  # Of the most probable set
    weights: Weights  # About them
    best: Set  # That set
    odds: Odds  # Of all sets
    strokes: Sequence[Stroke]  # As estimated with these laws
    first: Mapping[str, float]  # The declared coefficients, fitted without any effect
    with_lift: Set  # The same and the lift, fitted beside the effects of the set


def search(
    tracks: Sequence[Track],
    model: AnalyticModel,
    surfaces: Surfaces,
    settings: Settings,
    catalogue: Sequence[type[Effect]],
    tell: Callable[[str], None],
    jobs: int,
) -> Found:
    """What a model lacks, by the sightings of tracks that one camera saw.

    Args: settings: their coefficients are fitted to all strokes, with priors of these widths.
    Raises: ValueError: fewer than `LEAST` strokes whose place is known well.
    """
    declared = dict(settings.coefficients)
    given = {name: float(value.detach()) for name, value in model.named_parameters()}
    laws = Laws(model, surfaces, settings, declared, {name: given[name] for name in declared})
    tell("estimating strokes")
    strokes: Sequence[Stroke] = all_estimated(laws, tracks, jobs)
    if len(strokes) < LEAST:
        raise ValueError(
            f"a diagnosis of one camera's strokes needs {LEAST} of them, each with a bounce in the picture that shows "
            f"how far away it is; got {len(strokes)} of {len(tracks)}. Film more, or from higher above the table."
        )
    tell("looking at the noise of flights and bounces")
    laws = with_likeliest_noise(laws, [stroke.track for stroke in strokes], jobs)
    absent = np.array([given[name] for name in declared])
    for _ in range(2):
        tell("fitting the declared coefficients")
        place = _Place(laws, tracks, (), absent, jobs).weighed()
        laws, strokes = place.moved(place.best).laws, place.strokes
    first = dict(laws.values)
    laws, asked, centre = _asking(laws, strokes, model, catalogue)
    tell(f"filming strokes again with each of {len(asked)} effects")
    start = _Place(laws, tracks, asked, np.append(absent, centre), jobs).weighed()
    climbed = []
    for name in _likely(start.weights):
        tell(f"following {name}")
        climbed.append(_climbed(start, name))
        tell("  " + ", ".join(f"{n} {value:.3g}" for n, value in climbed[-1].best.strengths.items()))
    places = [start, *climbed]
    odds = odds_of([place.weights for place in places])
    for _ in range(ROUNDS):
        names = max(odds.models, key=lambda names: odds.models[names])
        end = max(places, key=lambda place: _odds_at(place, names))
        listed = [h for h in asked if h.name in names]
        tell("fitting the most probable effects")
        places.append(_fitted(end, listed))
        odds = odds_of([place.weights for place in places])
        if names == max(odds.models, key=lambda names: odds.models[names]):
            break
    end = places[-1]
    best = end.weights.weighed(listed)
    tell("fitting the lift beside the declared coefficients")
    return Found(end.laws, end.weights, best, odds, end.strokes, first, _with_lift(end, model, declared))


def _with_lift(end: "_Place", model: AnalyticModel, declared: Mapping[str, float]) -> Set:
    """The declared coefficients and the lift, which is not free in the search: it would take over a part of effects."""
    lift = model.declared_coefficients().get(LIFT)
    sizes = dict(declared) | ({LIFT: lift.sigma} if lift is not None and lift.sigma > 0.0 else {})
    given = {name: float(model.get_parameter(name).detach()) for name in sizes}
    laws = replace(end.laws, settings=replace(end.laws.settings, coefficients=sizes))
    pictured = {name: value for name, value in laws.values.items() if name in NAMES}
    values = {name: laws.values.get(name, given[name]) for name in sizes} | pictured
    place = _Place(replace(laws, sizes=sizes, values=values), end.tracks, (), np.array(list(given.values())), end.jobs)
    place = place.weighed()
    return place.moved(place.best).weighed(place.weights.slopes).weights.weighed(())


def _odds_at(place: "_Place", names: frozenset[str]) -> float:
    """The odds of a set about the laws of a place; -inf if it was not weighed there."""
    one = place.weights.known(names)
    return -np.inf if one is None else one.odds


def _fitted(place: "_Place", listed: Sequence[Hypothesis]) -> "_Place":
    """The place to which the strengths of some effects lead; that of laws without any stays."""
    for _ in range(MOST_STEPS if listed else 0):
        found = place.weights.fitted(listed)
        if _is_settled(place, found):
            break
        place = place.moved(found).weighed(place.weights.slopes)
    return place


def _likely(weights: Weights) -> list[str]:
    """The effects that are worth following: each of them alone is not much less probable than none, and than all."""
    odds = {h.name: weights.best_with(h.name).odds for h in weights.hypotheses}
    least = max(weights.weighed(()).odds - WORSE, max(odds.values()) - FOLLOWED_FROM)
    return sorted((name for name in odds if odds[name] > least), key=lambda name: -odds[name])[:FOLLOWED]


@dataclass(frozen=True)
class _Place:
    """Laws, the weights about them, and the most probable set that was followed there."""

    laws: Laws
    tracks: Sequence[Track]
    asked: Sequence[Hypothesis]
    absent: Array
    jobs: int
    strokes: Sequence[Stroke] = ()
    told: Weights | None = None
    followed: Set | None = None

    @property
    def weights(self) -> Weights:
        """About the laws."""
        assert self.told is not None
        return self.told

    @property
    def best(self) -> Set:
        """The set that was followed; none if none was."""
        return self.followed or self.weights.weighed(())

    def weighed(self, slopes: Array | None = None) -> "_Place":
        """The place with its weights; slopes: of laws nearby, in place of those of these laws.

        The noise is the same about all laws, so that rounds end where it does not move them.
        """
        laws = self.laws
        strokes = all_estimated(laws, self.tracks, self.jobs)
        seeds = [SEED + k for k in range(REPEATS)]
        bigger = [laws.moved({name: laws.values[name] + size}) for name, size in laws.sizes.items()]
        changed = [] if slopes is not None else [(one, seeds[0]) for one in bigger]
        scores = scores_again(laws, [*((laws, seed) for seed in seeds), *changed], strokes, self.jobs)
        mean, spread = mean_of(np.array([stroke.scores for stroke in strokes]), scores[:REPEATS])
        slopes = slopes_of(scores[0], scores[REPEATS:]) if slopes is None else slopes
        names, sizes = tuple(laws.sizes), np.array(list(laws.sizes.values()))
        values, declared = np.array([laws.values[name] for name in names]), len(laws.settings.coefficients)
        arrays = (sizes, values, self.absent, declared, mean, spread, slopes)
        return replace(self, strokes=strokes, told=Weights(names, *arrays, len(strokes), self.asked))

    def moved(self, best: Set) -> "_Place":
        """The place with the strengths of a set, and without all other effects."""
        absent = dict(zip(self.weights.names, self.weights.absent.tolist(), strict=True))
        return replace(self, laws=self.laws.moved(absent | best.strengths), followed=best)


def _climbed(start: _Place, name: str) -> _Place:
    """The place of the most probable set that holds an effect: rounds with slopes of laws nearby, then of its own."""
    place = start.moved(start.weights.best_with(name))
    for number in range(ROUNDS):
        slopes = place.weights.slopes if number < ROUNDS - 1 else None
        place = place.weighed(slopes)
        best = place.weights.best_with(name)
        same = best.names == place.best.names and _is_settled(place, best)
        if same and slopes is not None:
            place = place.weighed()
            break
        if number < ROUNDS - 1:
            place = place.moved(best)
    return replace(place, followed=place.weights.best_with(name))


def _is_settled(place: _Place, best: Set) -> bool:
    """True if the strengths of a set's effects, which follow the declared ones, are where the laws have them."""
    now = np.array([place.laws.values[column] for column in best.unknown])
    far = np.abs(best.values - now) / best.sigmas
    return bool((far[place.weights.declared :] <= SETTLED).all())


def _asking(
    laws: Laws, strokes: Sequence[Stroke], model: AnalyticModel, catalogue: Sequence[type[Effect]]
) -> tuple[Laws, list[Hypothesis], Array]:
    """The laws with all effects of the catalogue that one camera can be asked about, and where each is absent.

    Left out are effects of one place in the room, of positions and labels, and those that resemble a wrong clock.
    """
    known = [e for e in catalogue if e.kind != "measurement" and e.name not in CLOCKS]
    listed = hypotheses(model, _scene(strokes), known)
    asked = [h for h in listed if h.strengths and h.choices == 1]
    whole = laws.model
    for hypothesis in asked:
        whole = hypothesis.added_to(whole)
    asked += [Hypothesis(error, strengths=(error.coefficients[0].name,)) for error in ERRORS]
    columns = [column for h in asked for column in h.columns]
    sizes = dict(zip(columns, np.concatenate([scales(h) for h in asked]).tolist(), strict=True))
    centre = np.concatenate([centres(h, whole) for h in asked])
    values = {**laws.values, **dict(zip(columns, centre.tolist(), strict=True))}
    return replace(laws, model=whole, sizes={**laws.sizes, **sizes}, values=values), asked, centre


def _scene(strokes: Sequence[Stroke]) -> Scene:
    """The extent of strokes."""
    states = np.concatenate([stroke.estimate.states for stroke in strokes])
    places = states[:, POSITION]
    falls = np.concatenate([stroke.estimate.falls for stroke in strokes])
    extent = (places.min(axis=0), places.max(axis=0), np.median(places, axis=0))
    low, high, middle = (cast(Vector, tuple(place.tolist())) for place in extent)
    speed = float(np.median(np.linalg.norm(states[:, VELOCITY], axis=1)))
    return Scene(low, high, middle, speed, float(np.median(falls)) if len(falls) else float("nan"), len(falls), 0)
