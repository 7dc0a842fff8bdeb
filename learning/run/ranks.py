"""Starts processes that train one model; they add up sums, exchange values, and end together.

A process is a rank. Each rank owns tracks by their number, independent of the batch, so that its memory of a track
stays with it. A single process is the case of one rank: nothing is sent, and the numbers are the same up to rounding.
"""

import multiprocessing
import os
import signal
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from ctypes import c_int
from dataclasses import dataclass
from multiprocessing import resource_tracker
from threading import Thread
from types import FrameType
from typing import Any, TypeVar

import torch
import torch.distributed as dist
import torch.distributed.nn.functional
from torch import Tensor
from torch.distributed import TCPStore
from torch.multiprocessing import get_context
from torch.multiprocessing.spawn import ProcessContext, ProcessExitedException, start_processes

T = TypeVar("T")
TOLD_BY_FIRST = 1  # Exit status of a process that prints nothing because the first one prints the reason


def for_others(rank: int, error: BaseException) -> BaseException:
    """The exception that the first rank raises in place of one of another rank; a plain one, which can be sent."""
    if isinstance(error, KeyboardInterrupt):
        return KeyboardInterrupt()
    if isinstance(error, (ValueError, TypeError, OSError)):
        return ValueError(str(error))
    return RuntimeError(f"process {rank} failed:\n{''.join(traceback.format_exception(error))}")


@dataclass
class Ranks:
    """This process, number `rank` from 0, among the `size` that train."""

    rank: int = 0
    size: int = 1
    _working: bool = False
    _interrupted: bool = False

    @property
    def first(self) -> bool:
        """True for the process that writes and prints."""
        return self.rank == 0

    def own(self, tracks: Sequence[int]) -> list[int]:
        """The tracks among some that this rank owns, in their order."""
        return [track for track in tracks if track % self.size == self.rank]

    def sum(self, values: Tensor) -> Tensor:
        """(n,) sum over ranks of (n,) float64 values, in the order of the ranks and so the same bits on each."""
        if self.size == 1:
            return values
        parts = [torch.empty_like(values) for _ in range(self.size)]
        dist.all_gather(parts, values)
        return torch.stack(parts).sum(dim=0)

    def gather(self, value: T) -> list[T]:
        """The values of all ranks, on every rank."""
        if self.size == 1:
            return [value]
        values: list[Any] = [None] * self.size
        dist.all_gather_object(values, value)
        return values

    def from_first(self, work: Callable[[], T]) -> T:
        """The result of `work` on the first rank, which alone runs it, on every rank. Raises: as `together`."""
        box: list[Any] = [self.together(lambda: work() if self.first else None)]
        if self.size > 1:
            dist.broadcast_object_list(box, src=0)
        return box[0]

    def together(self, work: Callable[[], T]) -> T:
        """Run this rank's share of the work. When it fails or is interrupted on one rank, it ends on all of them.

        Raises: on the first rank, the exception of `work`, its own or one of the same kind for another rank's;
            SystemExit on all other ranks, which print nothing.
        """
        if self.size == 1:
            return work()
        result, error = None, None
        try:
            with self._interruptible():
                result = work()
        except (Exception, KeyboardInterrupt) as raised:
            error = raised
        told = self.gather(None if error is None else for_others(self.rank, error))
        trouble = next((each for each in told if each is not None), None)
        if trouble is not None and not self.first:
            raise SystemExit(TOLD_BY_FIRST) from error
        if error is not None:
            raise error
        if trouble is not None:
            raise trouble
        return result  # type: ignore[return-value]

    @contextmanager
    def _interruptible(self) -> Iterator[None]:
        """Let Ctrl-C interrupt. Elsewhere, while ranks wait for each other, it is kept until the next such block."""
        self._working = True
        try:
            if self._interrupted:
                raise KeyboardInterrupt
            yield
        finally:
            self._working = False

    def _on_interrupt(self, _signal: int, _frame: FrameType | None) -> None:
        if self._working:
            self._working = False  # a terminal and a parent may both send it
            raise KeyboardInterrupt
        self._interrupted = True


class SharedMemory:
    """The memory of all ranks, each of which updates the tracks that it owns.

    After a run is resumed, every rank holds the memory of all tracks, and that of other ranks' tracks becomes outdated.
    A rank therefore sends its changes only.
    """

    def __init__(self, given: Mapping[str, Tensor] | None = None) -> None:
        self.given = {name: tensor.clone() for name, tensor in (given or {}).items()}

    def gather(self, ranks: Ranks, own: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The memory of all ranks, on every rank. Args: own: memory of this rank."""
        known = self.given
        changed = {name: new for name, new in own.items() if name not in known or not torch.equal(new, known[name])}
        forgotten = [name for name in known if name not in own]
        merged = dict(known)
        for theirs, gone in ranks.gather((changed, forgotten)):
            merged |= theirs
            for name in gone:
                del merged[name]
        return merged


@contextmanager
def join_ranks() -> Iterator[Ranks]:
    """Join the processes that torchrun or `launch` has started; a single rank where neither did.

    Environment: WORLD_SIZE, RANK, MASTER_ADDR, MASTER_PORT as torchrun sets them. The backend is gloo, on CPUs.
    """
    torch.set_num_threads(1)  # the batches are small: threads cost more than they gain
    if not started_by_launcher():
        yield Ranks()
        return
    dist.init_process_group("gloo", init_method="env://")
    ranks: Ranks = Ranks(dist.get_rank(), dist.get_world_size())
    handled = (signal.SIGINT, signal.SIGTERM) if ranks.size > 1 else ()  # torchrun hands SIGTERM on
    before = {number: signal.signal(number, ranks._on_interrupt) for number in handled}
    try:
        yield ranks
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        dist.destroy_process_group()


def started_by_launcher() -> bool:
    """True if this process is one of several that a launcher has started."""
    return "RANK" in os.environ and "WORLD_SIZE" in os.environ


HOST = "127.0.0.1"
GRACE = 60.0
"""s that interrupted processes have to end by themselves: compiled code notices Ctrl-C only when it returns."""
NO_STATUS = -1  # Exit status of a process that has not returned
LAST_WORDS = 10.0  # s that the other processes have to print their errors once one of them has died


def launch(processes: int, work: Callable[..., int], *arguments: Any) -> int:
    """Run `work` in several processes, which `join_ranks` joins to one group.

    Args: work: a function of a module, which returns an exit status; its arguments can be pickled.
    Returns: the status of the first process.
    Raises:
        ChildProcessError: if a process was killed.
        KeyboardInterrupt: after Ctrl-C, and if the first process ended before it could return.
    """
    store = TCPStore(HOST, 0, is_master=True, wait_for_workers=False)
    # without a lock: its semaphore would outlive a kill
    status: c_int = get_context("spawn").Value("i", NO_STATUS, lock=False)
    resource_tracker.ensure_running()  # it lets signals through in this process
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # a process that still imports prints tracebacks
    try:
        shared = processes, store.port, status, work, arguments
        group = start_processes(_take_part, shared, nprocs=processes, join=False)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        _wait(group)
    except ProcessExitedException as error:
        raise ChildProcessError(
            f"training process {error.error_index} was ended from outside ({error.signal_name or error.exit_code}). "
            "Memory may have run out: set jobs lower, and continue with --resume."
        ) from None
    if status.value == NO_STATUS:  # a process interrupted while torch starts it ends without a message
        raise KeyboardInterrupt
    return status.value


def _take_part(
    rank: int, processes: int, port: int, status: c_int, work: Callable[..., int], arguments: tuple[Any, ...]
) -> None:
    """Set the environment as torchrun does, then work."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    Thread(target=_end_with_parent, daemon=True).start()
    os.environ.update(
        RANK=str(rank),
        LOCAL_RANK=str(rank),
        WORLD_SIZE=str(processes),
        MASTER_ADDR=HOST,
        MASTER_PORT=str(port),
        TORCHELASTIC_USE_AGENT_STORE=str(True),  # the parent holds the store: its port cannot be taken meanwhile
        TORCHELASTIC_RESTART_COUNT="0",
    )
    try:
        found = work(*arguments)
    except SystemExit:  # the first process prints the reason
        return
    if rank == 0:
        status.value = found


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _wait(group: ProcessContext) -> None:
    """Wait until all have ended. Ctrl-C is handed on, and processes that do not end in time are killed."""
    deadline: float | None = None
    while True:
        try:
            left = None if deadline is None else deadline - time.monotonic()
            if left is not None and left <= 0.0:
                _kill(group)
                return
            if group.join(left, grace_period=LAST_WORDS):
                return
        except KeyboardInterrupt:
            if deadline is not None:
                _kill(group)
                raise
            deadline = time.monotonic() + GRACE
            for process in group.processes:
                if process.is_alive():
                    os.kill(process.pid, signal.SIGINT)


def _kill(group: ProcessContext) -> None:
    for process in group.processes:
        process.kill()
        process.join()
