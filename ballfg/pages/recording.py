"""Records shots for the viewer rerun, for logs that are too large for a page; it needs the extra `viewer`."""

from pathlib import Path
from typing import Any

import numpy as np

from ballfg.pages.shot import ShownShot, unbroken
from ballfg.pages.shown import Shown

RADIUS = 0.02  # m, of the moving ball, as large as a table-tennis ball
SPIN_LENGTH = 0.001  # m of an arrow for each rad/s of spin
FLAT = 0.005  # m, half the thickness of the drawn table


def record(shown: Shown, path: Path) -> None:
    """Writes a recording: samples, estimates and predictions of each shot on its own clock.

    Args: shown: result of `collect`.  path: of the file, .rrd.
    Raises: ValueError: the package `rerun-sdk` is missing.
    """
    rerun = check_rerun()
    recording = rerun.RecordingStream("ballfg show")
    recording.save(str(path))
    if shown.table is not None:
        (x0, x1, y0, y1), height = shown.table.extent, shown.table.height
        middle, half = [(x0 + x1) / 2, (y0 + y1) / 2, height - FLAT], [(x1 - x0) / 2, (y1 - y0) / 2, FLAT]
        recording.log("table", rerun.Boxes3D(centers=[middle], half_sizes=[half]), static=True)
    for shot in shown.shots:
        _shot(rerun, recording, shot)
    recording.flush()
    recording.disconnect()


def check_rerun(option: str = "rerun") -> Any:
    """The package rerun for an option of a command. Raises: ValueError: it is missing."""
    try:
        import rerun
    except ImportError as error:
        raise ValueError(
            f"{option} must have the package rerun-sdk; got {error}. Install it: pip install 'ballfg[viewer]'."
        ) from None
    return rerun


def _shot(rerun: Any, recording: Any, shot: ShownShot) -> None:
    start, name = shot.start, f"shots/{rerun.escape_entity_path_part(shot.name)}"
    if len(shot.times):
        recording.log(f"{name}/measured", rerun.Points3D(shot.positions, radii=0.004), static=True)
    for what, _, places, _ in shot.lines:
        if runs := unbroken(places):
            recording.log(f"{name}/{what}", rerun.LineStrips3D([places[run] for run in runs]), static=True)
    for time, state in zip(shot.state_times, shot.states, strict=True):
        recording.set_time("time in the shot", duration=float(time) - start)
        recording.log(f"{name}/ball", rerun.Points3D([state[:3]], radii=RADIUS))
        if np.isfinite(state[6:]).all():
            recording.log(f"{name}/spin", rerun.Arrows3D(origins=[state[:3]], vectors=[SPIN_LENGTH * state[6:]]))
    for kind in ("contact", "hit"):
        marked = [mark.place for mark in shot.marks if mark.kind == kind]
        if marked:
            recording.log(f"{name}/{kind}s", rerun.Points3D(marked, radii=0.01), static=True)
