"""What two processes of a group say to each other; run by `test_ranks` through `launch`."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from ballfg.learning.run.ranks import Ranks, join_ranks


def talk(folder: Path) -> int:
    """Write what this rank saw; the status 7 is only to be handed on."""
    with join_ranks() as ranks:
        found = {
            "sum": ranks.sum(torch.tensor([0.1, 1.0, 1e16]) * (1 + ranks.rank)).tolist(),
            "gather": ranks.gather(f"rank {ranks.rank}"),
            "from_first": ranks.from_first(lambda: f"read by {ranks.rank}"),
            "own": ranks.own([5, 4, 3]),
            "input": _ended(ranks, _only(1, ranks, lambda: _raise(FileNotFoundError("no data. Give some.")))),
            "fault": _ended(ranks, _only(1, ranks, lambda: _raise(ZeroDivisionError("odd")))),
            "writing": _ended(ranks, _only(0, ranks, lambda: _raise(OSError("full")))),
            "interrupt": _ended(ranks, _only(1, ranks, lambda: os.kill(os.getpid(), signal.SIGINT))),
        }
        if ranks.rank == 1:
            os.kill(os.getpid(), signal.SIGINT)  # between two pieces of work: kept until the next one
        found["gather after interrupt"] = ranks.gather(3)
        found["late interrupt"] = _ended(ranks, lambda: None)
    tasks = Path("/proc/self/task")  # where there is one
    found["threads"] = [(task / "comm").read_text() for task in tasks.iterdir()] if tasks.exists() else []
    (folder / f"{ranks.rank}.json").write_text(json.dumps(found))
    return 7


def die() -> int:
    """As the kernel does when memory runs out."""
    os.kill(os.getpid(), signal.SIGKILL)
    return 0


def _raise(error: Exception) -> None:
    raise error


def _only(rank: int, ranks: Ranks, work: Callable[[], Any]) -> Callable[[], Any]:
    return work if ranks.rank == rank else lambda: None


def _ended(ranks: Ranks, work: Callable[[], Any]) -> list[str]:
    """Type and text of what ends a piece of work."""
    try:
        ranks.together(work)
    except BaseException as error:
        return [type(error).__name__, str(error)]
    return []
