"""Tensors from safetensors files, the only form in which weights are read."""

from pathlib import Path

from safetensors.torch import load_file
from torch import Tensor

from ballfg.files.damaged import library_reads


def read_tensors(path: Path) -> dict[str, Tensor]:
    """The tensors of a file by name.

    Raises: ValueError: a damaged file, the message names it. FileNotFoundError: no such file.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} must be a file of weights; there is none. Copy it again.")
    with library_reads(path, "safetensors"):
        return load_file(path)
