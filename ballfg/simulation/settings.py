"""Lists the combinations of the launcher's integer settings, and their order."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.checks import check_instance, check_iterable, is_number, shown
from ballfg.simulation.streams import Purpose, generator

SETTING_LEVELS: Final[Mapping[str, range]] = {"topspin": range(-3, 6), "sidespin": range(-5, 6), "speed": range(8, 15)}
"""Levels of the paper's launcher: 9 x 11 x 7 = 693 combinations. The keys are the names of the labels."""

Settings = NDArray[np.int64]  # (n, 3) topspin, sidespin and velocity level


def all_settings(chosen: Mapping[str, Sequence[int]] | None = None) -> Settings:
    """Every combination of levels, (m, 3) numbers of topspin, sidespin and velocity levels.

    Args: chosen: levels by setting, for restricted settings.
    Raises: ValueError: an unknown setting, a level that the launcher does not have, or no level at all.
    """
    levels: dict[str, Sequence[int]] = dict(SETTING_LEVELS)
    given = {} if chosen is None else chosen
    check_instance("settings", given, Mapping, "Write them like {'topspin': [0, 3]}.")
    for name, values in given.items():
        if name not in SETTING_LEVELS:
            raise ValueError(f"settings must be {', '.join(SETTING_LEVELS)}; got {shown(name)}. Rename it.")
        offered = SETTING_LEVELS[name]
        check_iterable(name, values)
        wrong = [value for value in values if not is_number(value) or value not in offered]
        if wrong or not values:
            got = shown(wrong[0]) if wrong else "nothing"
            raise ValueError(f"{name} must lie in {offered[0]} .. {offered[-1]}; got {got}. Choose whole levels.")
        levels[name] = list(dict.fromkeys(values))
    return np.array(list(itertools.product(*(levels[name] for name in SETTING_LEVELS))), dtype=np.int64)


def settings_of_shots(combinations: Settings, first: int, count: int, seed: int) -> Settings:
    """(count, 3) settings of the shots `first`, `first + 1` ...

    Every combination is shot once, in shuffled order, before any is repeated: 717 shots are the 693 combinations
    and 24 repeats. A shot's settings depend on its number and the seed only, so that blocks can be made one by one.
    """
    size = len(combinations)
    passes = range(first // size, (first + count - 1) // size + 1)
    order = np.concatenate([generator(seed, Purpose.SETTINGS, p).permutation(size) for p in passes])
    start = first - passes[0] * size
    return combinations[order[start : start + count]]


def parse_settings(text: str) -> dict[str, list[int]]:
    """Levels by setting from a text such as `topspin=-3,sidespin=-5..5,speed=9`.

    Raises: ValueError: a text of another form, or a setting given twice. Levels are checked by `all_settings`.
    """
    chosen: dict[str, list[int]] = {}
    for part in text.split(","):
        name, _, levels = part.partition("=")
        low, dots, high = levels.partition("..")
        try:
            bounds = int(low), int(high if dots else low)
        except ValueError:
            raise ValueError(
                f"settings must read NAME=LEVEL or NAME=FROM..TO, separated by commas; got '{part.strip()}'. "
                "Write for instance topspin=-3,sidespin=-5..5,speed=9."
            ) from None
        name = name.strip()
        if name in chosen:
            raise ValueError(f"settings must name each setting once; got '{name}' twice. Remove one.")
        chosen[name] = list(range(bounds[0], bounds[1] + 1))
    return chosen
