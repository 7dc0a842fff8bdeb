"""Looking for balls in a video does not load what it has no use for."""

from __future__ import annotations

from tests.interpreter import fresh


def test_detection_does_without_torch() -> None:
    code = "import sys, ballfg.vision.detection.detect; print('torch' in sys.modules, 'matplotlib' in sys.modules)"
    assert fresh(code).stdout.split() == ["False", "False"]
