"""What several rooms' tests share."""

from __future__ import annotations

import gc
import os
import signal

import pytest

from ballfg.dynamics import EFFECTS, AnalyticModel
from ballfg.machine import collect_rarely
from ballfg.progress import VARIABLE

collect_rarely()  # as the commands do
os.environ[VARIABLE] = "1"  # what commands print must not depend on how long they take
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as a shell has it for what it starts in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)  # tests send it to the processes that they start


@pytest.fixture
def every_effect() -> AnalyticModel:
    """Every effect at once, away from its defaults."""
    values = {
        "gravity": {"g": 9.79},
        "drag": {"k": 0.13},
        "magnus": {"k": 0.0031},
        "spin_decay": {"rate": 0.3},
        "restitution": {"e": 0.91},
        "friction": {"mu": 0.22},
        "tangential_restitution": {"e_t": 0.2},
        "table_height": {"offset": -0.004},
    }
    return AnalyticModel([EFFECTS[name](**v) for name, v in values.items()])


def pytest_collection_finish() -> None:
    """Leaves what was imported and collected out of Python's looks for garbage: each took up to 0.3 s, 250 times."""
    gc.collect()
    gc.freeze()
