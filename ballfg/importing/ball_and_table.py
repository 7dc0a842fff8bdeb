"""Determines the ball by its drag and the table's height by the bounces."""

from collections.abc import Sequence
from typing import Final

from ballfg.importing.bounces import surface
from ballfg.importing.choices import Choices, Guess, UndecidedError
from ballfg.importing.frame import Frame
from ballfg.tracks import TABLE_TENNIS, Ball, Track
from ballfg.tracks.info import TENNIS

BALLS: Final = {"table-tennis": TABLE_TENNIS, "tennis": TENNIS}
_TENNIS_DRAG: Final = 0.045  # 1/m; halfway, in ratio, between the drags of the two balls
_SURE_WINDOWS: Final = 30  # number of flight parts from which their drag distinguishes the balls


def ball_of(choices: Choices, frame: Frame) -> tuple[Ball, Guess]:
    """The ball, and the confidence in it.

    Args: choices: of the user.  frame: with the drag (1/m) of the flights.
    Raises: FileNotFoundError, ValueError: an unknown chosen ball, or a file that cannot be read.
    """
    if choices.ball is not None:
        from ballfg.simulation.balls import ball_kind

        ball = BALLS[choices.ball] if choices.ball in BALLS else ball_kind(choices.ball).ball
        return ball, Guess("ball", choices.ball, "as given", "stated", f"--ball {choices.ball}")
    why, sure = "too little flight to show the drag", "unsure"
    if frame.drag is not None and frame.windows >= _SURE_WINDOWS:
        why = f"the drag is only {frame.drag:.2f} 1/m (a tennis ball has 0.02): if it is another ball, name it"
        if frame.drag >= _TENNIS_DRAG:
            why, sure = f"drag {frame.drag:.2f} 1/m; a table-tennis ball has 0.13, a tennis ball 0.02", "likely"
    return TABLE_TENNIS, Guess("ball", "table-tennis", why, sure, "--ball tennis")


def table_of(tracks: Sequence[Track], ball: Ball, choices: Choices) -> tuple[float, Guess]:
    """The height of the table's surface in m, and the confidence in it.

    Args: tracks: in m and s with z up.  ball: its radius lies between a bounce and the surface.  choices: of the user.
    Raises: UndecidedError: no bounce shows it.
    """
    if choices.table_height is not None:
        height = choices.table_height
        return height, Guess("table height", f"{height:g} m", "as given", "stated", f"--table-height {height:g}")
    found = surface((track.seconds, track.positions) for track in tracks)
    if found is None:
        lowest = min(float(track.positions[:, 2].min()) for track in tracks)
        what = f"no bounce shows the height of the table (m, along the up axis); the lowest sample is at {lowest:.2f} m"
        raise UndecidedError(what, "table-height", (), f"{lowest - ball.radius:.2f}" if lowest > 0.5 else "0.76")
    height = round(found.centre - ball.radius, 4)
    others = "".join(f"; also at {other - ball.radius:.2f} m" for other in found.others)
    one = "1 bounce" if found.bounces == 1 else f"{found.bounces} bounces"
    why = f"{one}, scatter {1e3 * found.spread:.1f} mm{others}"
    sure = "sure" if found.bounces >= 3 and not found.others else "likely"
    return height, Guess("table height", f"{height:g} m", why, sure, f"--table-height {height:g}")
