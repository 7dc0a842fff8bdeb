"""Colours of tracks in the pictures of a recording, the same track the same in all of them."""

from typing import Final

TRACKS: Final = ("#e69f00", "#56b4e9", "#f0e442", "#cc79a7", "#00c08b", "#ff7f50")
"""Light colours that differ for every kind of colour vision (after Okabe and Ito) and stand out on green, blue and grey
images."""


def hexadecimal(track: int) -> str:
    """The colour of a track by its number, as #rrggbb."""
    return TRACKS[track % len(TRACKS)]


def bgr(track: int) -> tuple[int, int, int]:
    """The same as blue, green, red, each 0 .. 255."""
    text = hexadecimal(track)
    red, green, blue = (int(text[i : i + 2], 16) for i in (1, 3, 5))
    return blue, green, red
