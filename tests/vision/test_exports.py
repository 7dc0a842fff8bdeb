"""What `ballfg.vision` hands out, and that looking for balls does not load what it has no use for."""

from __future__ import annotations

import subprocess
import sys

import pytest

import ballfg.vision


def test_every_name_is_there() -> None:
    for name in ballfg.vision.__all__:
        assert getattr(ballfg.vision, name).__module__.startswith(("ballfg.vision.", "collections", "typing"))
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = ballfg.vision.nonsense


def test_detection_does_without_torch() -> None:
    code = "import sys, ballfg.vision.detection.detect; print('torch' in sys.modules, 'matplotlib' in sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.split() == ["False", "False"]
