"""The viewer draws a ball from its first position to its loss; here into a file, where tests have no window."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from ballfg.live import Tracker
from ballfg.live.outlook import look_out
from ballfg.live.viewer import Viewer
from ballfg.prediction.plane import Plane
from tests.live.shots import SURFACES, ball_model, ball_settings, rows, shots

pytest.importorskip("rerun", reason="the extra 'viewer' is not installed")


def test_a_ball_is_drawn(tmp_path: Path) -> None:
    viewer = Viewer(0.3, tmp_path / "live.rrd")
    live = Tracker(ball_model(), SURFACES, ball_settings())
    for t, *position in rows(shots(1)[0])[:9]:
        for update in live.push(t, position):
            viewer.see(update, None if update.state is None else look_out(update.state, 0.3, Plane.parse("x=1")))
    for update in live.end():
        viewer.see(update, None)
    viewer.close()
    command = [sys.executable, "-m", "rerun", "rrd", "print", str(tmp_path / "live.rrd")]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    for name in ("/measured", "/ball_1/state", "/ball_1/velocity", "/ball_1/path"):
        assert name in printed
