"""The choice where work runs: made once, by `--jobs` or `--cluster`, and asked by all that share work out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Protocol

from ballfg.checks import check_count, shown
from ballfg.machine import MOST_JOBS
from ballfg.parallel.work import is_inside

CLUSTERS = ("dask", "ray")
"""Kinds of clusters, by the extra of ballfg that installs their library."""

_CLUSTER: ContextVar[Executor | None] = ContextVar("cluster", default=None)


class Pending(Protocol):
    """A chunk that was handed over."""

    def done(self) -> bool:
        """Whether `result` returns, or raises, at once."""
        ...

    def result(self) -> Any:
        """The result of the chunk, as soon as it is there; raises what the function raised."""
        ...

    def cancel(self) -> object:
        """Gives the chunk up, as far as nobody works on it."""
        ...


class Executor(Protocol):
    """Processes that compute chunks: of this machine, or of a cluster."""

    batch: int
    """Tracks in a chunk."""

    helped: bool
    """Whether the process that asks is one of them: then it computes chunks itself where it would wait."""

    @property
    def slots(self) -> int:
        """How many chunks others compute at the same time."""
        ...

    def sender(self, function: Callable[[Sequence[Any]], Any]) -> Callable[[Sequence[Any]], Pending]:
        """Hands a function of a chunk over, and returns what then hands its chunks over, one by one."""
        ...

    def stop(self) -> None:
        """Ends what was begun, at once: after an error, or Ctrl-C."""
        ...


def executor(jobs: int, *, helped: bool = True) -> Executor | None:
    """Where work goes: to the cluster of `on_cluster`, else to `jobs` processes; None where it stays in this process.

    Inside of a chunk it always stays.

    Args: jobs: number of processes.  helped: whether this one is one of them; else it only waits.
    """
    check_count("jobs", jobs, 1, MOST_JOBS)
    if is_inside():
        return None
    cluster = _CLUSTER.get()
    if cluster is not None or jobs < 2:
        return cluster
    from ballfg.parallel.processes import Processes

    return Processes(jobs, helped=helped)


@contextmanager
def on_cluster(kind: str | None, address: str | None = None) -> Iterator[int | None]:
    """All work of ballfg inside of the `with` block goes to a cluster, in place of processes of this machine.

    Results are the same, bit for bit, as in one process, where all machines have processors of one type.

    Example:
        with on_cluster("dask", "tcp://10.0.0.1:8786"):
            states = bf.estimate("shots")

    Args:
        kind: "dask" or "ray"; None leaves everything as it is.
        address: of dask's scheduler, such as tcp://10.0.0.1:8786, or of a ray cluster; by default the ray cluster that
            this machine belongs to.
    Returns: the number of workers; None without a cluster.
    Raises:
        ValueError: another kind, an address without a kind or the reverse, a library that is not installed, or workers
            with other versions of ballfg, torch or numpy.
        ConnectionError: nothing answers at the address, or no workers are there.
    """
    if kind is None:
        if address is not None:
            raise ValueError(
                f"address must come with a cluster; got {shown(address)} alone. Add --cluster dask or ray."
            )
        yield None
        return
    if kind not in CLUSTERS:
        raise ValueError(f"cluster must be {' or '.join(CLUSTERS)}; got {shown(kind)}. Choose one of them.")
    opened = _open(kind, address)
    token = _CLUSTER.set(opened)
    try:
        yield opened.slots
    finally:
        _CLUSTER.reset(token)
        opened.close()


def _open(kind: str, address: str | None) -> Any:
    if kind == "dask":
        from ballfg.parallel.dask_cluster import DaskCluster

        return DaskCluster(address)
    from ballfg.parallel.ray_cluster import RayCluster

    return RayCluster(address)
