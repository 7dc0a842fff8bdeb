"""Describes the networks of a learned model by numbers for a file."""

from typing import Annotated, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field

Kind = Literal["mlp", "mlp+gs", "skip+gs", "mnn+gs"]

MOST_WIDTH: Final = 2048  # Hidden units; such a layer takes 34 MB
MOST_DEPTH: Final = 20

DEFAULT_SIZES: Final[dict[Kind, tuple[int, int, int]]] = {
    "mlp": (39, 40, 3),
    "mlp+gs": (39, 40, 3),
    "skip+gs": (39, 40, 2),
    "mnn+gs": (54, 55, 4),
}
"""Width of the flight network, width of the contact network, depth: 7,320 to 7,327 parameters, and 6
more for a launcher with two settings."""


class Architecture(BaseModel):
    """The networks of a learned model. `Architecture.of(kind)` has each kind's default sizes."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    kind: Kind
    """mlp sees raw velocity and spin; the others see Gram-Schmidt features."""
    width_flight: Annotated[int, Field(ge=1, le=MOST_WIDTH)]
    """Hidden units of the flight network."""
    width_contact: Annotated[int, Field(ge=1, le=MOST_WIDTH)]
    """Hidden units of the contact network."""
    depth: Annotated[int, Field(ge=1, le=MOST_DEPTH)]
    """Hidden layers (mlp), blocks (skip), or repetitions of the one layer (mnn) of each network."""
    residual: bool = False
    """True: the networks correct another model; False: they are the whole model."""
    spin_rate: bool = False
    """The flight network also gives the angular acceleration; false: the spin is constant in flight (or the base's)."""

    @classmethod
    def of(
        cls,
        kind: Kind,
        *,
        width_flight: int | None = None,
        width_contact: int | None = None,
        depth: int | None = None,
        residual: bool = False,
        spin_rate: bool = False,
    ) -> Self:
        """An architecture with the kind's default for each size that is not given."""
        given = (width_flight, width_contact, depth)
        sizes = (size if own is None else own for own, size in zip(given, DEFAULT_SIZES[kind], strict=True))
        named = dict(zip(("width_flight", "width_contact", "depth"), sizes, strict=True))
        return cls(kind=kind, **named, residual=residual, spin_rate=spin_rate)
