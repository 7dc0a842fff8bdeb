"""Draws how a hall looks in a broadcast: table, lines, floor, ball, barriers, line judges, size of the pictures."""

from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.benchmarks.cameras.hall import FLOOR, Colour, Look

SIZES: Final = ((640, 360), (854, 480), (1280, 720), (1920, 1080))
"""px, of pictures."""
TABLES: Final = ((150, 80, 30), (190, 120, 50), (70, 90, 25), (48, 45, 45), (90, 40, 15))
"""Colours: blue, light blue, green, dark grey, dark blue."""
FLOORS: Final = ((45, 40, 150), (140, 70, 40), (120, 120, 118), (95, 140, 180), (35, 32, 30), (80, 95, 60))
"""Colours: red, blue, grey, wood, dark, green."""
LINES: Final = ((240, 240, 240), (200, 205, 205), (70, 50, 210))
"""Colours: white, dull white, red."""
WHITE, ORANGE = (235, 240, 240), (50, 140, 250)
"""Colours of balls."""
SHIRTS: Final = ((40, 40, 45), (40, 40, 190), (170, 60, 30), (60, 150, 60))
"""Colours of players and judges."""
DARK: Final = 60
"""Grey levels of dark tables and floors, at most."""
HALF_MIDDLE: Final = (0.0015, 0.0025)
"""m, half the width of the middle line (3 mm by ITTF Law 2.1.5)."""

HALF_TAPE: Final = 0.005
"""m, half the thickness of the net's tape and cord, which shows from above the net."""


def drawn_look(rng: np.random.Generator, ball: Colour = WHITE) -> Look:
    """A look; red lines lie on dark tables and floors, with dark nets."""
    table = TABLES[rng.integers(len(TABLES))]
    floor, wall = (FLOORS[rng.integers(len(FLOORS))] for _ in range(2))
    dark = max(table) < DARK and max(floor) < DARK
    lines = LINES[rng.integers(len(LINES) if dark else 2)]
    barriers = FLOORS[rng.integers(len(FLOORS))] if rng.random() < 0.7 else None
    net = (70, 60, 40) if dark or rng.random() < 0.6 else (150, 150, 150)
    return Look(table, lines, net, floor, wall, ball, barriers, 0.01, rng.uniform(*HALF_MIDDLE), HALF_TAPE)


def judges(rng: np.random.Generator) -> list[tuple[Array, Colour]]:
    """An umpire behind the net's far post, and two judges beside the ends: polygons and colours."""
    found = list[tuple[Array, Colour]]()
    for x, y in ((0.0, 2.6), (-4.0, 3.1), (4.0, 3.1)):
        x, y = x + rng.normal(0.0, 0.2), y + rng.normal(0.0, 0.1)
        for wide, low, high, colour in (
            (0.22, FLOOR, 0.35, SHIRTS[rng.integers(len(SHIRTS))]),
            (0.09, 0.35, 0.6, (120, 150, 200)),
        ):
            body = [(x - wide, y, low), (x + wide, y, low), (x + wide, y, high), (x - wide, y, high)]
            found.append((np.array(body), colour))
    return found
