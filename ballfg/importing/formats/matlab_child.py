"""Reads one MATLAB file in a process of its own: scipy's reader can end the process that reads a damaged file.

Run as a script with the path and the most bytes that its arrays may take; it needs scipy alone. To standard output it
writes a pickled pair: `content` and the variables, `too large` and their bytes, `hdf5` for version 7.3, or `error`
and the words of one.
"""

import math
import pickle
import sys
from typing import Any

import scipy.io


def read(path: str, most: int) -> tuple[str, Any]:
    """Outcome and content of a file. Args: path: of it.  most: bytes that its arrays may take."""
    try:
        size = 8 * sum(math.prod(map(int, shape)) for _, shape, _ in scipy.io.whosmat(path))
        if size > most:
            return "too large", size
        return "content", scipy.io.loadmat(path, simplify_cells=True)
    except NotImplementedError:
        return "hdf5", None
    except Exception as error:  # of any class: the file is not what scipy expects
        return "error", str(error) or type(error).__name__


if __name__ == "__main__":
    pickle.dump(read(sys.argv[1], int(sys.argv[2])), sys.stdout.buffer)
