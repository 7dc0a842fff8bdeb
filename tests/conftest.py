"""What several rooms' tests share."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from ballfg.dynamics import EFFECTS, AnalyticModel, BallModel
from ballfg.dynamics.compiled import motion
from ballfg.dynamics.compiled.functions import CompiledModel
from ballfg.machine import collect_rarely
from ballfg.progress import VARIABLE

collect_rarely()  # as the commands do
os.environ[VARIABLE] = "1"  # what commands print must not depend on how long they take
for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:  # in the background of a shell, and under nohup
        signal.signal(number, handler)  # tests send them to the processes that they start


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


@contextmanager
def _in_torch() -> Iterator[None]:
    machine_code = motion.compiled

    def compiled(model: BallModel) -> CompiledModel | None:
        return machine_code(model) if isinstance(model, AnalyticModel) else None

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(motion, "compiled", compiled)
        yield


@pytest.fixture
def networks_in_torch() -> Iterator[None]:
    """Networks move in torch, the definition of their machine code, which takes up to half a minute to make."""
    with _in_torch():
        yield


@pytest.fixture(scope="module")
def all_networks_in_torch() -> Iterator[None]:
    """The same for a whole module, and for fixtures that it shares."""
    with _in_torch():
        yield


def pytest_collection_finish() -> None:
    """Leaves what was imported and collected out of Python's looks for garbage: each took up to 0.3 s, 250 times."""
    gc.collect()
    gc.freeze()
