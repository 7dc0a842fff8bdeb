"""When Python collects garbage, and who keeps freed memory."""

import platform
import subprocess
import sys

import pytest

from ballfg.machine import IMPORTED, MADE

CODE = """
import gc
from ballfg.machine import collect_rarely
collect_rarely()
print(gc.get_threshold()[0])
gc.collect()
print(gc.get_threshold()[0], len(gc.callbacks))
"""


def test_the_first_collection_waits_for_the_imports_and_later_ones_come_as_objects_are_made() -> None:
    said = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True).stdout
    assert said.split() == [str(IMPORTED), str(MADE), "0"]


ARRAYS = """
import resource
import numpy as np
from ballfg.machine import keep_memory
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(10):
        np.ones((1 << 20,)), np.ones((3 << 20,))  # 8 and 24 MB, freed at once
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
first = faults()
keep_memory()
faults()
print(first, faults())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another libc has no such option")
def test_freed_memory_serves_the_next_arrays() -> None:
    said = subprocess.run([sys.executable, "-c", ARRAYS], capture_output=True, text=True, check=True).stdout
    usual, kept = map(int, said.split())
    assert kept < usual / 100
