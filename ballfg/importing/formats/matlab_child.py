"""Reads one MATLAB file in a process of its own: scipy's reader can end the process that reads a damaged file.

Run as a script with the path and the most bytes that its arrays may take; it needs scipy alone. To standard output it
writes a pickled pair: `content` and the variables, `too large` and their bytes, `hdf5` for version 7.3, or `error`
and the words of one.
"""

import math
import pickle
import sys
from pathlib import Path
from typing import Any

import scipy.io


def read(path: str, most: int) -> tuple[str, Any]:
    """Outcome and content of a file. Args: path: of it.  most: bytes that its arrays may take."""
    try:
        _bound_memory(2 * most)  # what is packed, and what is unpacked of it
        size = 8 * sum(math.prod(map(int, shape)) for _, shape, _ in scipy.io.whosmat(path))
        if size > most:
            return "too large", size
        return "content", scipy.io.loadmat(path, simplify_cells=True)
    except MemoryError:  # structures and cells do not tell what they hold
        return "too large", 2 * most
    except NotImplementedError:
        return "hdf5", None
    except Exception as error:  # of any class: the file is not what scipy expects
        return "error", str(error) or type(error).__name__
    finally:
        _bound_memory(None)


def _bound_memory(most: int | None) -> None:
    """Lets this process have so many bytes beside those that it has, or any number; on Linux alone."""
    status = Path("/proc/self/status")
    if not status.is_file():
        return
    import resource

    now = 1024 * int(status.read_text().partition("VmData:")[2].split()[0])
    bound = resource.RLIM_INFINITY if most is None else now + most
    resource.setrlimit(resource.RLIMIT_DATA, (bound, resource.RLIM_INFINITY))


if __name__ == "__main__":
    pickle.dump(read(sys.argv[1], int(sys.argv[2])), sys.stdout.buffer)
