"""Describes the horizontal surfaces that a ball can meet: a table, and the floor for a ball that falls beside it."""

import math
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
from numba.extending import register_jitable

from ballfg.checks import check_array, check_number, is_number
from ballfg.dynamics.motion.limits import DEEPEST
from ballfg.state import Z

TABLE_ABOVE_FLOOR: Final = 0.76  # m, height of a table-tennis table (ITTF Laws 2.1.1)
TABLE_LENGTH: Final = 2.74  # m (ITTF Laws 2.1.1)
TABLE_WIDTH: Final = 1.525  # m (ITTF Laws 2.1.1)


@register_jitable
def within(x: Any, y: Any, ends: Any) -> Any:
    """Whether places lie within ends (x_low, x_high, y_low, y_high) m, in torch and in machine code."""
    return (x >= ends[0]) & (x <= ends[1]) & (y >= ends[2]) & (y <= ends[3])


@dataclass(frozen=True)
class Surfaces:
    """Table and floor, as heights in the world frame.

    Attributes:
        table_height: m, z of the table's surface; -inf where there is no surface at all (`none`).
        floor_height: m, z of the floor; None where there is no floor below (a court is its own floor).
        extent: (x_low, x_high, y_low, y_high) m of the table; infinite for an unknown end. None if no end is known: the
            table then lies under every ball whose centre is above its surface.
        edge_sigmas: (x_low, x_high, y_low, y_high) m, standard deviations of those ends, for predictions near them.

    Raises: ValueError: a height that is neither finite nor -inf, a floor above the table, an extent out of order, a
        negative sigma.
    """

    table_height: float = 0.0
    floor_height: float | None = None
    extent: tuple[float, float, float, float] | None = None
    edge_sigmas: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not (is_number(self.table_height) and self.table_height == -math.inf):
            check_number("table_height", self.table_height, "m")
        floor = None if self.floor_height is None else check_number("floor_height", self.floor_height, "m")
        if floor is not None and not floor < self.table_height:
            raise ValueError(f"floor_height must lie below table_height {self.table_height:g} m; got {floor:g} m")
        ends = None if self.extent is None else check_array("extent", self.extent, (4,), "Give four numbers in m.")
        if ends is not None and not (ends[0] < ends[1] and ends[2] < ends[3]):
            raise ValueError(f"extent must be (x_low, x_high, y_low, y_high); got {self.extent}")
        sigmas = check_array("edge_sigmas", self.edge_sigmas, (4,), "Give four numbers in m.")
        if not ((sigmas >= 0.0) & (sigmas < math.inf)).all():
            raise ValueError(f"edge_sigmas must be finite and not negative, in m; got {self.edge_sigmas}")

    @classmethod
    def table_tennis(cls, table_height: float) -> Self:
        """A table at a height in the room, with the floor 0.76 m below its surface; of -inf none."""
        return cls.none() if table_height == -math.inf else cls(table_height, table_height - TABLE_ABOVE_FLOOR)

    @classmethod
    def none(cls) -> Self:
        """No surface: a ball flies, is struck, thrown or caught, and never bounces."""
        return cls(-math.inf)

    def __str__(self) -> str:
        if not self.heights():
            return "no surface"
        names = ("x >= {:.2f} m", "x <= {:.2f} m", "y >= {:.2f} m", "y <= {:.2f} m")
        ends = [name.format(end) for name, end in zip(names, self.extent or (), strict=False) if math.isfinite(end)]
        return f"table at {self.table_height:g} m" + (f" within {', '.join(ends)}" if ends else "")

    def heights(self) -> tuple[float, ...]:
        """All surface heights, the table's first; empty where there is no surface."""
        known = (self.table_height, -math.inf if self.floor_height is None else self.floor_height)
        return tuple(height for height in known if height > -math.inf)

    def over_table(self, state: Any) -> Any:
        """(...) bool of states (..., 9), an array or a tensor: the ball's x, y lie within the table's extent."""
        if self.extent is None:
            return (state[..., 0] == state[..., 0]) | True
        return within(state[..., 0], state[..., 1], self.extent)

    def height_below(self, state: Any, raised: Any) -> Any:
        """(...) m, height of the surface below a ball in states (..., 9), straight down; -inf where there is none.

        A ball whose centre is below the table's surface is beside the table; `level_below` limits its depth.

        Args: state, raised: as of `level_below`.
        """
        return _where(self.over_table(state), self.level_below(state, raised), self._lower_level(state, raised))

    def level_below(self, state: Any, raised: Any) -> Any:
        """(...) m, height of the surface that a ball in states (..., 9) falls to, on the table or beside it.

        -inf where there is none: below the lowest surface by more than `DEEPEST`.

        Args:
            state: an array or a tensor.
            raised: (...) m by which surfaces lie above their declared heights there (`BallModel.surface_offset`).
        """
        above = state[..., Z] - raised > self.table_height
        return _where(above, self.table_height, self._lower_level(state, raised))

    def _lower_level(self, state: Any, raised: Any) -> Any:
        low = self.lowest()
        return _where(state[..., Z] - raised > low - DEEPEST, low, -math.inf)

    def lowest(self) -> float:
        """m, height of the lowest surface under a ball beside the table; -inf where there is none."""
        return -math.inf if self.floor_height is None else self.floor_height


def _where(mask: Any, yes: Any, no: Any) -> Any:
    """Choices by a mask, in torch for a tensor's."""
    if isinstance(mask, np.ndarray | np.bool_):
        return np.where(mask, yes, no)
    import torch

    return torch.where(mask, *(torch.as_tensor(one, dtype=torch.float64, device=mask.device) for one in (yes, no)))
