"""When Python collects garbage."""

import subprocess
import sys

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
