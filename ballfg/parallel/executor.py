"""Chooses where work runs, by `--jobs` or `--cluster`, for all code that distributes work."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Protocol

from ballfg.checks import check_count, shown
from ballfg.machine import MOST_JOBS
from ballfg.parallel.work import is_inside

CLUSTERS = ("dask", "ray")  # kinds of clusters, by ballfg's extra for their library
_CLUSTER: "ContextVar[Executor | None]" = ContextVar("cluster", default=None)


class Pending(Protocol):
    """A submitted chunk."""

    def done(self) -> bool:
        """True if `result` returns, or raises, at once."""

    def result(self) -> Any:
        """The result of the chunk, once it is there; raises the function's exceptions."""

    def cancel(self) -> bool | None:
        """Cancels the chunk unless a worker has begun it; True if it did, None if that is not known."""


class Executor(Protocol):
    """Processes that compute chunks, of this machine or of a cluster."""

    batch: int  # number of tracks in a chunk
    helped: bool  # True if the calling process is one of them: it then computes chunks itself instead of waiting

    @property
    def slots(self) -> int:
        """Number of chunks that others compute at the same time."""

    def sender(self, function: Callable[[Sequence[Any]], Any]) -> Callable[[Sequence[Any]], Pending]:
        """Submits a function of a chunk, and returns a function that submits its chunks one by one."""

    def stop(self) -> None:
        """Ends the present work at once: after an error, or Ctrl-C."""


def executor(jobs: int, *, helped: bool = True) -> Executor | None:
    """The executor: of `on_cluster`'s cluster, else of `jobs` processes; None for this process.

    Work inside of a chunk always stays in its process.

    Args: jobs: number of processes.  helped: True if this one is one of them; else it only waits.
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
    """Sends all work of ballfg inside of the `with` block to a cluster.

    Results equal those of one process bit for bit, if all machines have processors of one type.

    Example:
        with on_cluster("dask", "tcp://10.0.0.1:8786"):
            states = bf.estimate("shots")

    Args:
        kind: "dask" or "ray"; None changes nothing.
        address: of dask's scheduler, such as tcp://10.0.0.1:8786, or of a ray cluster; by default this machine's ray
            cluster.
    Returns: the number of workers; None without a cluster.
    Raises: ValueError: another kind, an address without a kind or the reverse, a library that is not installed, or
        workers with other versions of ballfg, torch or numpy. ConnectionError: nothing answers at the address, or no
        workers are there.
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
    from ballfg.parallel.clusters import DaskCluster, RayCluster

    opened = DaskCluster(address) if kind == "dask" else RayCluster(address)
    token = _CLUSTER.set(opened)
    try:
        yield opened.slots
    finally:
        _CLUSTER.reset(token)
        opened.close()
