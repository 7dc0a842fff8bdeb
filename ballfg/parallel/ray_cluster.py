"""Computes chunks on a ray cluster as tasks, which ray restarts after the loss of a worker."""

import pickle
from collections.abc import Callable, Sequence
from typing import Any, Final

from ballfg.checks import one_line
from ballfg.parallel.same_versions import HERE, differences, own_versions
from ballfg.parallel.work import Work, compute, packed, too_many_deaths

MOST_DEATHS: Final = 3  # largest number of workers that a chunk may lose


class RayCluster:
    """All processors of a ray cluster.

    Args: address: of the cluster; None for this machine's, or for the one that this process has joined.
    Raises: ValueError: ray is not installed, or nodes with other versions. ConnectionError: no cluster is there.
    """

    batch, helped = 16, False

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

    def sender(self, function: Callable[[Sequence[Any]], Any]) -> Callable[[Sequence[Any]], "_Chunk"]:
        """Submits a function of a chunk; see Executor."""
        work = Work.of(function)
        content = self._ray.put(work.content)

        submit = self._task.remote
        return lambda chunk: _Chunk(self._ray, submit(work.name, content, packed(chunk), own_versions()), chunk)

    def stop(self) -> None:
        """Does nothing: chunks are cancelled one by one, and the cluster continues without them."""

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


class _Chunk:
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
