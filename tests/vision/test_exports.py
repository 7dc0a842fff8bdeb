"""Looking for balls in a video does not load what it has no use for."""

from __future__ import annotations

import subprocess
import sys


def test_detection_does_without_torch() -> None:
    code = "import sys, ballfg.vision.detection.detect; print('torch' in sys.modules, 'matplotlib' in sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.split() == ["False", "False"]
