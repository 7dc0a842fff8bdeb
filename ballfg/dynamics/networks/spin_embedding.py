"""Maps launcher settings to the spin of a shot by a learned linear layer, in axes along the flight.

Axes: forward is the horizontal direction of flight, across is z x forward (topspin turns about it), up is z (sidespin
turns about it). Turning the velocity about z turns the spin. A mirrored launch has other settings (sidespin changes
its sign), so there is no mirror symmetry to keep.
Source: Q. Xiao, Z. Wu, M. Gombolay 2024, section III-B-2.
"""

from collections.abc import Mapping
from typing import Final

import torch
from torch import Tensor, nn

from ballfg.checks import shown
from ballfg.dynamics.population import SOFT_SPEED

SPIN_UNIT: Final = 100.0  # rad/s for a weight of one, so that weights are of order one


class SpinEmbedding(nn.Module):
    """Local spin = weight x settings.

    Args:
        labels: names of the labels that are settings; at least one. Those in `categories` are text, one-hot over their
            values; the others are numbers.
        categories: the values that each text label takes.
        initial: (k, 3) rad/s, local spin (forward, across, up) per unit of each setting; none: zero.

    Attributes: names: one for each setting: `topspin`, `group=backspin`.  weight: (3, k), in units of `SPIN_UNIT`.

    Raises: ValueError: if labels or the values of a category repeat, a category has no label, or `initial` has another
        shape.
    """

    def __init__(
        self, labels: tuple[str, ...], categories: Mapping[str, tuple[str, ...]], initial: Tensor | None = None
    ) -> None:
        super().__init__()
        if not labels or len(set(labels)) < len(labels):
            raise ValueError(f"labels must be names that differ, at least one; got {labels}. Name each label once.")
        unknown = sorted(set(categories) - set(labels))
        if unknown:
            raise ValueError(f"categories must be of labels; got '{unknown[0]}'. Add it to labels or remove it.")
        for label, values in categories.items():
            if not values or len(set(values)) < len(values):
                raise ValueError(f"categories['{label}'] must be values that differ, at least one; got {values}.")
        self.labels = tuple(labels)
        self.categories = {label: tuple(categories[label]) for label in labels if label in categories}
        choices = {label: [f"{label}={value}" for value in known] for label, known in self.categories.items()}
        self.names = tuple(name for label in labels for name in choices.get(label, [label]))
        start = torch.zeros(len(self.names), 3, dtype=torch.float64) if initial is None else initial
        if start.shape != (len(self.names), 3):
            raise ValueError(f"initial must have shape ({len(self.names)}, 3); got {tuple(start.shape)}.")
        self.weight = nn.Parameter(start.to(torch.float64).T.clone() / SPIN_UNIT)

    def settings(self, labels: Mapping[str, object]) -> Tensor | None:
        """(k,) the settings of a track with these labels, each in its own unit; None if one is missing or unknown.

        Raises: ValueError: if a label that must be a number is not one.
        """
        settings: list[float] = []
        for label in self.labels:
            value, known = labels.get(label), self.categories.get(label)
            if value is None or (known is not None and value not in known):
                return None
            if known is not None:
                settings += [float(value == other) for other in known]
            elif isinstance(value, int | float):
                settings.append(float(value))
            else:
                raise ValueError(
                    f"label '{label}' must be a number; got {shown(value)}. Declare its values as categories."
                )
        return torch.tensor(settings, dtype=torch.float64)

    def local(self, settings: Tensor) -> Tensor:
        """(..., 3) rad/s, spin about forward, across and up, from settings (..., k)."""
        return SPIN_UNIT * nn.functional.linear(settings, self.weight)

    def spin(self, settings: Tensor, velocity: Tensor) -> Tensor:
        """(..., 3) rad/s in the world.

        Args: settings: (..., k), each in its own unit.  velocity: (..., 3) m/s at the launch.
        """
        forward, across, up = self.local(settings).unbind(-1)
        x, y = velocity[..., 0], velocity[..., 1]
        scale = (x.square() + y.square() + SOFT_SPEED**2).rsqrt()
        x, y = x * scale, y * scale
        return torch.stack((forward * x - across * y, forward * y + across * x, up.expand_as(x)), dim=-1)
