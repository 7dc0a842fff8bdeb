"""Starts several training processes on this machine, as torchrun would."""

import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from ctypes import c_int
from multiprocessing import resource_tracker
from threading import Thread
from typing import Any

from torch.distributed import TCPStore
from torch.multiprocessing import get_context
from torch.multiprocessing.spawn import ProcessContext, ProcessExitedException, start_processes

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
