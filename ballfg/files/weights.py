"""Reads tensors from safetensors files, the only format of weights."""

from pathlib import Path
from typing import Final

from safetensors.torch import load_file
from torch import Tensor

from ballfg.files.damaged import library_reads

MAX_HEADER: Final = 1_000_000  # bytes of names and shapes in a file; those of this package's networks take some 2,000


def read_tensors(path: Path) -> dict[str, Tensor]:
    """The tensors of a file by name. Raises: ValueError: a damaged file. FileNotFoundError: no such file."""
    if not path.is_file():
        raise FileNotFoundError(f"{path} must be a file of weights; there is none. Copy it again.")
    with library_reads(path, "safetensors"):
        with path.open("rb") as file:
            header = int.from_bytes(file.read(8), "little")
        if header > MAX_HEADER:
            raise ValueError(f"it says that its header has {header} bytes, and may have {MAX_HEADER}")
        return load_file(path)
