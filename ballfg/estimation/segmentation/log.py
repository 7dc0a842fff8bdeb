"""Keeps the log of events small: what no hypothesis has is dropped, and what all of them have becomes final."""

from typing import Any

import numpy as np

from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT
from ballfg.estimation.segmentation.bank import BANK, LOG, LOGGED, NO_EVENT, Records


@machine_code(COUNT(BANK, LOG, COUNT))
def compact(kept: Records, log: Records, written: int) -> int:
    """Drops those of the first events that no hypothesis has; returns how many are left, at the beginning."""
    needed = np.zeros(written, np.int64)
    for row in range(len(kept)):
        tip = kept[row].tip
        while tip >= 0 and needed[tip] == 0:
            needed[tip] = 1
            tip = log[tip].before
    count = 0
    for row in range(written):
        if needed[row]:
            log[count] = log[row]
            if log[count].before >= 0:
                log[count].before = needed[log[count].before] - 2
            needed[row] = count + 2
            count += 1
    for row in range(len(kept)):
        if kept[row].tip >= 0:
            kept[row].tip = needed[kept[row].tip] - 2
    return count


@machine_code(LOG(COUNT, LOG))
def chain(tip: int, log: Records) -> Any:
    """The events up to one, oldest first."""
    count, event = 0, tip
    while event >= 0:
        count, event = count + 1, log[event].before
    found, event = np.empty(count, LOGGED), tip
    while event >= 0:
        count -= 1
        found[count] = log[event]
        event = log[event].before
    return found


@machine_code(COUNT(BANK, LOG, COUNT))
def decide(kept: Records, log: Records, row: int) -> int:
    """Drops the hypotheses that deny an event, and takes it and all before it out of the others.

    Returns: number of hypotheses that are left, at the beginning of `kept`.
    """
    count = 0
    for place in range(len(kept)):
        tip = kept[place].tip
        while tip > row:  # an event is written after those before it
            tip = log[tip].before
        if tip == row:
            kept[count] = kept[place]
            if kept[count].tip == row:
                kept[count].tip = NO_EVENT
            count += 1
    for later in range(row + 1, len(log)):
        if log[later].before == row:
            log[later].before = NO_EVENT
    return count
