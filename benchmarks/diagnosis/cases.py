"""Defines the cases of the loop's benchmark: datasets, and the effects that a diagnosis of each should find.

Planted is every catalogue effect at its own usual size, in pairs, and physics of no catalogue.
"""

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Final

import numpy as np

from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis
from ballfg.dynamics import EFFECTS, nominal_model
from ballfg.simulation.settings import SETTING_LEVELS

STATED_NOISE: Final = 0.003  # m, noise of positions that every dataset states; in most it is true
LABEL_NOISE: Final = 4.0  # rad/s per component, noise of spin labels that every dataset states
BARE: Final = ("magnus", "tangential_restitution", "table_height")
"""Effects removed from the nominal model to leave gravity, drag, restitution and friction."""


@dataclass(frozen=True)
class Plant:
    """An effect that acts although the declared model lacks it."""

    name: str  # of the effect
    amounts: tuple[tuple[str, float], ...]  # by coefficient, the addition at size 1
    base: float = 0.0  # value of those coefficients at size 0: the effect is absent, or as declared
    left_out: bool = False  # the nominal model has it; the declared model is the nominal one without it
    hidden: bool = False
    """Other effects or free coefficients do the same; an honest answer names one of those effects or says that it
    cannot be seen."""
    sized: bool = True  # it comes in sizes; else it is there or not

    def texts(self, size: float) -> tuple[str, ...]:
        """The effect at a size, 1 being typical, as a simulation reads it: `wind.x=0.2`."""
        return tuple(f"{self.name}.{c}={self.base + size * amount!r}" for c, amount in self.amounts)

    def hypothesis(self) -> Hypothesis:
        """The true hypothesis, with this effect in its true shape."""
        coefficients = EFFECTS[self.name].coefficients
        if not self.sized:
            whole = {c.name: c.default for c in coefficients} | {c: self.base + a for c, a in self.amounts}
            return Hypothesis(EFFECTS[self.name], whole)
        shape = {c.name: c.default for c in coefficients if c.absent is None}
        return Hypothesis(EFFECTS[self.name], shape, tuple(c.name for c in coefficients if c.absent is not None))


FIRST: Final = (
    "wind", "restitution_speed", "frame_tilt", "magnus", "drag_spin", "spin_decay", "time_offset", "spin_label_scale",
)  # fmt: skip
"""The effects that serve for a quick look."""


def _plants() -> Iterator[Plant]:
    """One for each effect whose usual strength is known; those for a quick look first."""
    nominal = nominal_model()
    for name in (*FIRST, *(name for name in EFFECTS if name not in FIRST)):
        effect = EFFECTS[name]
        if effect.usual is None:
            continue
        changed = next(c for c in effect.coefficients if c.name in effect.usual.change)
        base = changed.default if changed.sigma == 0.0 or changed.absent is None else changed.absent
        left_out = changed.sigma > 0.0 and (name in nominal.flight or name in nominal.bounce)
        yield Plant(name, tuple(effect.usual.change.items()), base, left_out, effect.imitated, effect.usual.graded)


PLANTS: Final[dict[str, Plant]] = {plant.name: plant for plant in _plants()}
"""By name, at the strengths that the effects call usual."""

PAIRS: Final = (
    ("wind", "restitution_speed"),
    ("frame_tilt", "spin_decay"),
    ("magnus_saturation", "table_tilt"),
    ("drag_speed", "time_offset"),
    ("wind_shear", "spin_label_offset"),
)
"""Two at once, of typical sizes."""

UNKNOWN: Final[dict[str, tuple[tuple[str, ...], ...]]] = {
    "pull": (("pull.strength=1.0",),),
    "thick_air": (("thick_air.growth=0.5",),),
    "side_lean": (("side_lean.strength=0.3",),),
    "two_tables": ((), ("restitution.e=0.88", "table_height.offset=-0.011", "friction.mu=0.4")),
}
"""Physics that no catalogue holds: the undeclared effects of each session that a dataset consists of."""


@dataclass(frozen=True)
class Recording:
    """The recording settings of tracks.

    Attributes:
        tracks: number.  rate: Hz.  position: m and spin: rad/s, true noise of positions and labels.
        dropout, outliers: probability for each frame.  jitter: s, of the stamps.  labels: True if spins are labelled.
        levels: launcher levels by setting, for those that do not run through all of theirs.
    """

    tracks: int = 50
    rate: float = 120.0
    position: float = STATED_NOISE
    spin: float = LABEL_NOISE
    dropout: float = 0.0
    outliers: float = 0.0
    jitter: float = 0.0
    labels: bool = True
    levels: tuple[tuple[str, tuple[int, ...]], ...] = ()


@dataclass(frozen=True)
class Case:
    """One dataset, one diagnosis."""

    part: str  # of the benchmark
    subject: str  # the planted effect, in a word
    size: float  # of it; 1 is typical
    seed: int  # number of the repetition
    planted: tuple[str, ...] = ()  # names of the effects that the declared model lacks
    left_out: tuple[str, ...] = ()  # effects of the nominal model that the declared one lacks
    sessions: tuple[tuple[str, ...], ...] = ((),)
    """Undeclared effects, as texts, of each session that the dataset consists of."""
    recording: Recording = field(default_factory=Recording)  # settings of its tracks
    data: Path | None = None  # folder of measured tracks, which take the place of simulated ones
    change: str = ""  # name of a change of `CHANGES` that the measured tracks undergo; empty for none
    most: int | None = None  # number of measured tracks, evenly spread; None for all
    repair: bool = False  # fit the true model too
    jobs: int = 1  # processes of the diagnosis

    @property
    def name(self) -> str:
        """Name of its record."""
        return f"{self.part}-{self.subject}-{self.size:.4g}-{self.seed}"

    @property
    def stream(self) -> int:
        """Seed of its random numbers: every case has its own."""
        return zlib.crc32(self.name.encode())


@dataclass(frozen=True)
class Plan:
    """The amount of computation; by default everything.

    Attributes:
        effects, sizes: planted one by one, each in every size.
        unlabelled: names of effects planted in data without spin labels.  pairs: names of two planted together.
        seeds: of each at its typical size; the true model is fitted to the first of them.
        side_seeds: of each at other sizes, and of pairs.  unlabelled_seeds: where no spin is labelled.
        nulls: datasets that lack nothing.  unknown, unknown_seeds: physics outside the catalogue.
        timed: diagnoses that are timed alone.
        reliability: sets for the test of stated probabilities, which is a run of its own.
    """

    effects: tuple[str, ...] = tuple(PLANTS)
    unlabelled: tuple[str, ...] = tuple(name for name in PLANTS if not name.startswith("spin_label"))
    pairs: tuple[tuple[str, str], ...] = PAIRS
    sizes: tuple[float, ...] = (0.5, 1.0, 2.0)
    seeds: int = 4
    side_seeds: int = 1
    unlabelled_seeds: int = 2
    nulls: int = 100
    unknown: tuple[str, ...] = tuple(UNKNOWN)
    unknown_seeds: int = 3
    timed: int = 3
    reliability: int = 300


FULL: Final = Plan()
QUICK: Final = Plan(
    effects=FULL.effects[:8],
    unlabelled=FULL.unlabelled[:3],
    pairs=PAIRS[:1],
    sizes=(1.0,),
    seeds=1,
    side_seeds=1,
    unlabelled_seeds=1,
    nulls=5,
    unknown=FULL.unknown[:2],
    unknown_seeds=1,
    timed=1,
    reliability=4,
)


def planted_case(part: str, name: str, size: float, seed: int) -> Case:
    """A case with one catalogue effect."""
    plant = PLANTS[name]
    left_out = (name,) if plant.left_out else ()
    return Case(part, name, size, seed, (name,), left_out, (plant.texts(size),))


def naming_cases(plan: Plan, seed: int) -> Iterator[Case]:
    """Every effect in every size, pairs, and effects where no spin is labelled."""
    for number, name, size in product(range(seed, seed + plan.seeds), plan.effects, plan.sizes):
        if size == 1.0 or (PLANTS[name].sized and number < seed + plan.side_seeds):
            yield replace(planted_case("naming", name, size, number), repair=size == 1.0 and number == seed)
    for number, (one, other) in product(range(seed, seed + plan.side_seeds), plan.pairs):
        texts = (*PLANTS[one].texts(1.0), *PLANTS[other].texts(1.0))
        left_out = tuple(name for name in (one, other) if PLANTS[name].left_out)
        yield Case("pairs", f"{one}+{other}", 1.0, number, (one, other), left_out, (texts,))
    for number, name in product(range(seed, seed + plan.unlabelled_seeds), plan.unlabelled):
        yield replace(planted_case("no_labels", name, 1.0, number), recording=Recording(labels=False))


def null_cases(plan: Plan, seed: int) -> Iterator[Case]:
    """Datasets without missing effects that differ in everything else."""
    for number in range(plan.nulls):
        yield Case("silence", "nothing", 1.0, seed + number, recording=null_recording(seed + number))


def null_recording(seed: int) -> Recording:
    """Noise of 1 to 6 mm where 3 are stated, and every other trouble of real tracks."""
    rng = np.random.default_rng(seed)
    few = tuple(
        (name, tuple(sorted(rng.choice(levels, 2, replace=False).tolist()))) for name, levels in SETTING_LEVELS.items()
    )
    return Recording(
        tracks=int(rng.integers(12, 61)),
        rate=float(rng.choice([60.0, 100.0, 120.0, 180.0, 240.0])),
        position=1e-3 * float(np.exp(rng.uniform(0.0, np.log(6.0)))),
        dropout=float(rng.uniform(0.0, 0.2)),
        outliers=float(rng.uniform(0.0, 0.02)),
        jitter=float(rng.uniform(0.0, 0.5e-3)),
        labels=bool(rng.random() < 0.5),
        levels=few if rng.random() < 0.5 else (),
    )


def unknown_cases(plan: Plan, seed: int) -> Iterator[Case]:
    """Cases with physics outside of every catalogue."""
    for number, name in product(range(seed, seed + plan.unknown_seeds), plan.unknown):
        yield Case("unknown", name, 1.0, number, sessions=UNKNOWN[name])


def measured_cases(folders: Sequence[Path]) -> Iterator[Case]:
    """Each measured dataset with the nominal model and with gravity, drag and the bounce only.

    Raises: ValueError: if two folders have the same name.
    """
    for name, folder in by_name(folders).items():
        yield Case("measured", name, 1.0, 0, data=folder)
        yield Case("measured", f"{name}-bare", 1.0, 0, planted=BARE, left_out=BARE, data=folder)


def by_name(folders: Sequence[Path]) -> dict[str, Path]:
    """Folders of datasets by their names. Raises: ValueError: if two have the same name."""
    found: dict[str, Path] = {}
    for folder in folders:
        name = folder.resolve().name
        if name in found:
            raise ValueError(f"datasets must differ in the names of their folders; got '{name}' twice. Rename one.")
        found[name] = folder
    return found


def timed_cases(plan: Plan, seed: int) -> Iterator[Case]:
    """Diagnoses that have the machine for themselves, with two processes: a wind, 50 tracks."""
    for number in range(seed, seed + plan.timed):
        yield replace(planted_case("time", "wind", 1.0, number), jobs=2)


def all_cases(plan: Plan, seed: int, data: Sequence[Path]) -> list[Case]:
    """Everything that may run side by side, parts evenly mixed: an early look sees something of all.

    Args: data: folders of measured tracks.
    """
    parts = [
        list(measured_cases(data)),
        list(naming_cases(plan, seed)),
        list(null_cases(plan, seed)),
        list(unknown_cases(plan, seed)),
    ]
    placed = [(number / len(part), case) for part in parts for number, case in enumerate(part)]
    return [case for _, case in sorted(placed, key=lambda pair: pair[0])]
