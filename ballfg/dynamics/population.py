"""A population says how the spins of a launcher's, a player's or a session's shots scatter, group by group.

Most of a short flight's prediction error comes from a spin that nobody measured. Shots of one launcher are alike: their
spins have a mean and a spread of their own about each axis, which tell more than a wide prior about zero.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, Self

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import check_number, listed, shown
from ballfg.tracks.track import Label, label_text, level_of

SOFT_SPEED: Final = 0.05
"""m/s. Well below it a launch has no horizontal direction and its forward and across axes fade out; at 5 m/s they are
5e-5 short of one."""
FASTEST: Final = 5000.0  # rad/s. Largest mean and spread; a larger one is in another unit
UNSEEN: Final = ""  # Name of a group that no label has
_FIELDS: Final = ("by", "groups")


@dataclass(frozen=True)
class SpinGroup:
    """The spins of one group of shots, about forward (the horizontal direction of flight), across and up.

    Across is z x forward: topspin turns about it.

    Attributes:
        mean: (3,) rad/s.  sigma: (3,) rad/s, standard deviations of a new shot about the mean.
        tracks: number of tracks behind both, the weight in the mixture.

    Raises: ValueError: a number that is not finite, a sigma that is not positive, no track. TypeError: no number.
    """

    mean: tuple[float, float, float]
    sigma: tuple[float, float, float]
    tracks: int

    def __post_init__(self) -> None:
        for name, values, above in (("mean", self.mean, None), ("sigma", self.sigma, 0.0)):
            if len(values) != 3:
                raise ValueError(f"{name} must be three numbers in rad/s; got {shown(values)}. Give one per axis.")
            for value in values:
                check_number(f"each {name}", value, "rad/s", above=above, limit=FASTEST)
        if isinstance(self.tracks, bool) or not isinstance(self.tracks, int) or self.tracks < 1:
            raise ValueError(f"tracks must be a number of tracks, at least 1; got {shown(self.tracks)}.")


@dataclass(frozen=True)
class SpinPopulation:
    """The spins of groups of shots.

    Attributes:
        by: the label that names a track's group; tracks without it belong to no known group.
        groups: by the label's text.

    Raises: ValueError: without a group.
    """

    by: str
    groups: Mapping[str, SpinGroup]

    def __post_init__(self) -> None:
        if not self.groups:
            raise ValueError("groups must hold at least one group; got none. Leave the section out.")

    def spin(self, group: str | None) -> tuple[Array, Array]:
        """Mean (3,) rad/s and covariance (3, 3) of the spin of a group's shot: forward, across, up.

        Args: group: its name; an unknown one, or None, has the mean and the covariance of the mixture of all groups.
        """
        known = None if group is None else level_of(group, self.groups)
        members = list(self.groups.values()) if known is None else [self.groups[known]]
        share = np.array([member.tracks for member in members], dtype=np.float64)
        share /= share.sum()
        means, sigmas = (np.array([getattr(m, name) for m in members]) for name in ("mean", "sigma"))
        mean = share @ means
        away = means - mean
        return mean, np.diag(share @ sigmas**2) + (share * away.T) @ away

    def with_unseen(self, sigma: float) -> Self:
        """The population with one group more, of shots that nobody has recorded: about zero, as many as of the others.

        Args: sigma: rad/s, usual prior of each axis.
        """
        tracks = max(1, round(sum(member.tracks for member in self.groups.values()) / len(self.groups)))
        unseen = SpinGroup((0.0, 0.0, 0.0), (sigma,) * 3, tracks)
        return replace(self, groups={**self.groups, UNSEEN: unseen})

    def check(self, group: str) -> None:
        """Refuses an unknown group. Raises: ValueError: if there is no such group."""
        if level_of(group, self.groups) is None:
            raise ValueError(
                f"group must be one of the model's, {listed(self.groups)}; got {shown(group)}. Leave it out for the "
                "mixture of all groups."
            )

    def unknown(self, labels: Iterable[Mapping[str, Label]]) -> tuple[str, ...]:
        """A sentence on tracks whose groups are not known, from the labels of each; none without such a track."""
        named = [own[self.by] for own in labels if self.by in own]
        others = [label for label in named if level_of(label, self.groups) is None]
        if not others:
            return ()
        return (
            f"{len(others)} of {len(named)} tracks are of groups ({self.by}) that the model does not know, such as "
            f"{shown(label_text(others[0]))}: they get {self.of_others}",
        )

    @property
    def of_others(self) -> str:
        """The prior of tracks of no known group, in words."""
        return f"the mixture of its groups, {listed(self.groups)}, and of the usual prior"

    @classmethod
    def from_mapping(cls, content: Any) -> Self:
        """The population in a model file. Raises: ValueError: an entry is missing, unknown, or of another kind."""
        if not isinstance(content, Mapping) or set(content) != set(_FIELDS):
            raise ValueError(f"must be a mapping with 'by' and 'groups'; got {shown(content)}")
        by, groups = (content[name] for name in _FIELDS)
        if not isinstance(by, str) or not isinstance(groups, Mapping):
            raise ValueError(f"'by' must be text and 'groups' a mapping; got {shown(content)}")
        return cls(by, {str(name): _group(str(name), one) for name, one in groups.items()})

    def to_mapping(self) -> dict[str, Any]:
        """The mapping that `from_mapping` reads."""
        groups = {n: {"mean": list(g.mean), "sigma": list(g.sigma), "tracks": g.tracks} for n, g in self.groups.items()}
        return {"by": self.by, "groups": groups}


def launch_axes(velocity: Array) -> Array:
    """(3, 3) the unit vectors forward, across and up in the world, one a row, for a velocity (3,) m/s.

    A launch straight up has no forward direction: x stands for it.
    """
    speed = float(np.hypot(velocity[0], velocity[1]))
    x, y = (velocity[0] / speed, velocity[1] / speed) if speed > SOFT_SPEED else (1.0, 0.0)
    return np.array([[x, y, 0.0], [-y, x, 0.0], [0.0, 0.0, 1.0]])


def _group(name: str, content: Any) -> SpinGroup:
    if not isinstance(content, Mapping) or set(content) != {"mean", "sigma", "tracks"}:
        raise ValueError(f"groups.{name} must be a mapping with 'mean', 'sigma' and 'tracks'; got {shown(content)}")
    for entry in ("mean", "sigma"):
        if not isinstance(content[entry], list) or len(content[entry]) != 3:
            raise ValueError(f"groups.{name}.{entry} must be three numbers in rad/s; got {shown(content[entry])}")
    try:
        return SpinGroup(tuple(content["mean"]), tuple(content["sigma"]), content["tracks"])
    except (ValueError, TypeError) as error:
        raise ValueError(f"groups.{name}: {error}") from error
