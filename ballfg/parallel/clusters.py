"""Computes chunks on a cluster: on dask as futures, on ray as tasks, both of which outlive the loss of a worker.

joblib's own dask backend is not used: it takes from the stream as fast as workers compute, even if results are consumed
slowly, so that they pile up in memory.
"""

import logging
import math
import pickle
import re
import time
import uuid
from collections.abc import Callable, Sequence
from typing import Any, Final

from ballfg.checks import one_line
from ballfg.parallel.same_versions import HERE, differences, own_versions
from ballfg.parallel.work import Work, compute, packed, too_many_deaths

CONNECT: Final = 10.0  # s, timeout for dask's scheduler, and for its first worker
NOBODY: Final = 60.0  # s without any worker of dask after which the work ends
LOOK: Final = 5.0  # s between two checks of the cluster while dask computes a chunk
MOST_DEATHS: Final = 3  # largest number of workers of ray that a chunk may lose


class _Cluster:
    """What the executors of clusters share."""

    batch, helped = 16, False

    def stop(self) -> None:
        """Does nothing: chunks are cancelled one by one, and the cluster continues without them."""


class DaskCluster(_Cluster):
    """All workers of a scheduler.

    Args: address: of the scheduler, such as tcp://10.0.0.1:8786.
    Raises: ValueError: no address, `distributed` is not installed, or workers with other versions. ConnectionError: no
        scheduler or no worker is there.
    """

    def __init__(self, address: str | None) -> None:
        try:
            import distributed
        except ImportError:
            what = "cluster dask needs dask, which is not installed"
            raise ValueError(f'{what}. Run: pip install "ballfg[dask]"') from None
        if not re.fullmatch(r"(\w+://)?[^/]+:\d+", address or ""):
            problem = f"address must be that of a dask scheduler, such as tcp://10.0.0.1:8786; got {address}"
            raise ValueError(f"{problem}. Copy it from what the scheduler prints.")
        self._address, self._workers = address, 0
        self._looked, self._nobody_since = -LOOK, math.inf
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # important messages are raised here
        try:
            self._client = distributed.Client(address, timeout=CONNECT, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise ConnectionError(
                f"address must be that of a dask scheduler; nothing usable answers at {address} "
                f"({one_line(error) or type(error).__name__}). Start it: dask scheduler."
            ) from None
        try:
            self._check_workers()
        except BaseException:
            self._client.close()
            raise

    @property
    def slots(self) -> int:
        """Number of workers at the last check; each computes one chunk at a time."""
        if time.monotonic() - self._looked > LOOK:
            self.look()
        return max(1, self._workers)

    def sender(self, function: Callable[[Sequence[Any]], Any]) -> Callable[[Sequence[Any]], "_DaskChunk"]:
        """Submits a function of a chunk; see Executor.

        The function is the result of a task of its own, not scattered data: if its worker dies, dask computes it again.
        """
        work = Work.of(function)
        content = self._client.submit(bytes, work.content, key=f"ballfg-{work.name}-{uuid.uuid4().hex[:8]}")

        def send(chunk: Sequence[Any]) -> _DaskChunk:
            call = (compute, work.name, content, packed(chunk), own_versions())
            return _DaskChunk(self, self._client.submit(*call, key=f"ballfg-{uuid.uuid4().hex}"), chunk)

        return send

    def look(self) -> None:
        """Counts the workers. Raises: ConnectionError: the scheduler or, for `NOBODY` s, every worker has left."""
        try:
            workers = len(self._client.nthreads()) if self._client.status == "running" else None
        except (OSError, TimeoutError, RuntimeError):
            workers = None
        if workers is None:
            raise ConnectionError(f"the dask scheduler at {self._address} must stay while it is in use; it left.")
        self._workers, self._looked = workers, (now := time.monotonic())
        self._nobody_since = math.inf if workers else min(now, self._nobody_since)
        if now - self._nobody_since > NOBODY:
            rule = f"the dask scheduler at {self._address} must have workers"
            raise ConnectionError(f"{rule}; the last left {NOBODY:g} s ago.")

    def close(self) -> None:
        """Leaves the cluster unchanged."""
        self._client.close()

    def _check_workers(self) -> None:
        try:
            self._client.wait_for_workers(1, timeout=CONNECT)
        except TimeoutError:
            raise ConnectionError(
                f"the dask scheduler at {self._address} must have workers; got none within {CONNECT:g} s. "
                f"Start them: dask worker {self._address} --nworkers 4 --nthreads 1."
            ) from None
        for worker, theirs in self._client.run(eval, HERE).items():
            if different := differences(theirs, f"the worker {worker}"):
                raise ValueError(different)


class _DaskChunk:
    def __init__(self, cluster: DaskCluster, future: Any, chunk: Sequence[Any]) -> None:
        self._cluster, self._future, self._first = cluster, future, repr(chunk[0])

    def done(self) -> bool:
        """True if the result, or an error, is there."""
        return bool(self._future.done())

    def result(self) -> Any:
        """The result; see Pending. Raises: ChildProcessError: too many workers lost. ConnectionError: no cluster."""
        from distributed import KilledWorker

        while not self._future.done():
            try:
                self._future.result(timeout=LOOK)
            except TimeoutError:
                self._cluster.look()
            except Exception:  # raised again below
                break
        if self._future.cancelled():
            self._cluster.look()
            raise ConnectionError("the dask cluster gave a chunk up: its scheduler was probably started again.")
        try:
            return pickle.loads(self._future.result())
        except KilledWorker:
            raise too_many_deaths("dask", self._first) from None

    def cancel(self) -> None:
        """Cancels the chunk."""
        self._future.cancel()


class RayCluster(_Cluster):
    """All processors of a ray cluster.

    Args: address: of the cluster; None for this machine's, or for the one that this process has joined.
    Raises: ValueError: ray is not installed, or nodes with other versions. ConnectionError: no cluster is there.
    """

    def __init__(self, address: str | None) -> None:
        try:
            import ray
        except ImportError:
            raise ValueError('cluster ray needs ray, which is not installed. Run: pip install "ballfg[ray]"') from None
        self._ray, self._joined = ray, not ray.is_initialized()
        if self._joined:
            try:
                ray.init(address=address or "auto", logging_level="CRITICAL", log_to_driver=False)
            except (OSError, ValueError, RuntimeError, AssertionError) as error:
                raise ConnectionError(
                    f"address must be that of a ray cluster; nothing usable answers at {address or 'this machine'} "
                    f"({one_line(error)}). Start it: ray start --head."
                ) from None
        self._task = ray.remote(max_retries=MOST_DEATHS, num_cpus=1)(compute)
        try:
            self._check_nodes()
        except BaseException:
            self.close()
            raise

    @property
    def slots(self) -> int:
        """Number of processors; each computes one chunk at a time."""
        return max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    def sender(self, function: Callable[[Sequence[Any]], Any]) -> Callable[[Sequence[Any]], "_RayChunk"]:
        """Submits a function of a chunk; see Executor."""
        work = Work.of(function)
        content = self._ray.put(work.content)

        submit = self._task.remote
        return lambda chunk: _RayChunk(self._ray, submit(work.name, content, packed(chunk), own_versions()), chunk)

    def close(self) -> None:
        """Leaves the cluster unchanged."""
        if self._joined:
            self._ray.shutdown()

    def _check_nodes(self) -> None:
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        def asked(expression: str) -> Any:  # sent as a whole: a node without ballfg could not import it
            return eval(expression)

        for node in self._ray.nodes():
            if node["Alive"] and node["Resources"].get("CPU"):
                there = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
                theirs = self._ray.get(self._ray.remote(asked).options(scheduling_strategy=there).remote(HERE))
                if different := differences(theirs, f"the node {node['NodeManagerAddress']}"):
                    raise ValueError(different)


class _RayChunk:
    def __init__(self, ray: Any, sent: Any, chunk: Sequence[Any]) -> None:
        self._ray, self._sent, self._first = ray, sent, repr(chunk[0])

    def done(self) -> bool:
        """True if the result, or an error, is there."""
        return bool(self._ray.wait([self._sent], timeout=0)[0])

    def result(self) -> Any:
        """The result; see Pending. Raises: ChildProcessError: if the chunk lost too many workers."""
        try:
            return pickle.loads(self._ray.get(self._sent))
        except self._ray.exceptions.RayTaskError as error:
            raise error.cause from None
        except (self._ray.exceptions.WorkerCrashedError, self._ray.exceptions.OutOfMemoryError):
            raise too_many_deaths("ray", self._first) from None

    def cancel(self) -> None:
        """Cancels the chunk."""
        self._ray.cancel(self._sent)
