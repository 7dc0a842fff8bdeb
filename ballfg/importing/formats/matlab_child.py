"""Reads one MATLAB file in a process of its own, since scipy's reader can crash on a damaged file.

Run as a script with the path and the largest number of bytes of its arrays; it needs scipy alone. It writes a pickled
pair to standard output: `content` and the variables, `too large` and their bytes, `hdf5` for version 7.3, or `error`
and its message.
"""

import math
import pickle
import sys
from pathlib import Path
from typing import Any

import scipy.io


def read(path: str, most: int) -> tuple[str, Any]:
    """Outcome and content of a file. Args: path: of the file.  most: bytes of its arrays."""
    try:
        _bound_memory(2 * most)  # the packed and the unpacked data
        size = 8 * sum(math.prod(map(int, shape)) for _, shape, _ in scipy.io.whosmat(path))
        if size > most:
            return "too large", size
        return "content", scipy.io.loadmat(path, simplify_cells=True)
    except MemoryError:  # structures and cells do not state their size
        return "too large", 2 * most
    except NotImplementedError:
        return "hdf5", None
    except Exception as error:  # of any class: the file is not as scipy expects
        return "error", str(error) or type(error).__name__
    finally:
        _bound_memory(None)


def _bound_memory(most: int | None) -> None:
    """Bounds the further memory of this process to so many bytes; on Linux only."""
    status = Path("/proc/self/status")
    if not status.is_file():
        return
    import resource

    now = 1024 * int(status.read_text().partition("VmData:")[2].split()[0])
    bound = resource.RLIM_INFINITY if most is None else now + most
    resource.setrlimit(resource.RLIMIT_DATA, (bound, resource.RLIM_INFINITY))


if __name__ == "__main__":
    pickle.dump(read(sys.argv[1], int(sys.argv[2])), sys.stdout.buffer)
