"""Shows flying balls in the viewer rerun; it needs the extra `viewer`."""

from pathlib import Path

import numpy as np

from ballfg.live.outlook import Outlook, unusable
from ballfg.live.tracker import BallUpdate
from ballfg.pages.recording import check_rerun
from ballfg.prediction.crossing import Crossing

EVERY = 3  # Number of states per drawn path: the eye sees no more, and drawing takes time from the stream
SIGMAS = 2.0  # Radius of an event's ball in standard deviations of its place


class Viewer:
    """Shows measured positions, states, paths ahead and their events, on the stream's own clock.

    Args: horizon: s, of the paths.  save: a file .rrd in place of a window.
    Raises: ValueError: the package `rerun-sdk` is missing.
    """

    def __init__(self, horizon: float, save: Path | None = None) -> None:
        rerun = check_rerun("viewer")
        self.horizon = horizon
        self._rerun = rerun
        self._recording = rerun.RecordingStream("ballfg live")
        if save is None:
            self._recording.spawn()
        else:
            self._recording.save(str(save))

    def see(self, update: BallUpdate, outlook: Outlook | None) -> None:
        """Draws one update."""
        show, state = self._recording, update.state
        show.set_time("stream", duration=update.time)
        if update.position is not None:
            show.log("measured", self._rerun.Points3D([update.position], radii=0.004))
        if update.ball is None or state is None:
            return
        name = f"ball_{update.ball}"
        if update.kind == "lost":
            show.log(name, self._rerun.Clear(recursive=True))
            return
        show.log(f"{name}/state", self._rerun.Points3D([state.position], radii=0.02))
        show.log(f"{name}/velocity", self._rerun.Arrows3D(origins=[state.position], vectors=[0.05 * state.velocity]))
        for one in update.events:
            show.log(f"{name}/events", self._rerun.TextLog(f"{one.kind} at {one.time:.4f} s"))
        if outlook is not None and not outlook.note and update.samples % EVERY == 0 and not unusable(state):
            path = np.vstack((state.position, state.predict(self.horizon, step=0.02).positions))
            show.log(f"{name}/path", self._rerun.LineStrips3D([path]))
            for what in ("bounce", "apex", "crossing"):
                event: Crossing | None = getattr(outlook, what)
                drawn = self._rerun.Clear(recursive=False)
                if event is not None:
                    radius = SIGMAS * float(np.sqrt(np.trace(event.covariance[:3, :3]) / 3))
                    drawn = self._rerun.Points3D([event.state[:3]], radii=max(radius, 0.005))
                show.log(f"{name}/{what}", drawn)

    def close(self) -> None:
        """Flushes the pending drawings."""
        self._recording.flush()
