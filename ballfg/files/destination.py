"""Places to write to: refused where nothing can be written, or where something would be lost."""

from collections.abc import Collection
from pathlib import Path


def check_file(path: Path, argument: str = "out") -> None:
    """Refuses a path to which no file can be written.

    Args: path: of the file.  argument: its name in a message.
    Raises: FileNotFoundError: its folder does not exist. ValueError: it is a folder.
    """
    _check_parent(path, argument)
    if path.is_dir():
        raise ValueError(f"{argument} must be a file; {path} is a folder. Give the name of a file in it.")


def check_folder(folder: Path, argument: str = "out") -> None:
    """Refuses a path at which no folder can be made or written to.

    Args: folder: existing or not.  argument: its name in a message.
    Raises: FileNotFoundError: its parent does not exist. ValueError: it is a file.
    """
    _check_parent(folder, argument)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{argument} must be a folder; {folder} is a file. Choose another name.")


def check_replaceable(
    folder: Path, *, mark: str, what: str, only: Collection[str] | None = None, force: bool = True
) -> None:
    """Refuses a folder that holds something that must not be lost; a new or an empty one never does.

    Args:
        folder: to write to.
        mark: name of the file that tells an earlier result.
        what: such a result is called in a message.
        only: all names that an earlier result can have; None: other files may lie beside it.
        force: an earlier result may be replaced.
    Raises: ValueError: other content, or an earlier result and no `force`; else as `check_folder`.
    """
    check_folder(folder)
    present = {entry.name for entry in folder.iterdir()} if folder.exists() else set()
    if not present:
        return
    if not (folder / mark).is_file() or (only is not None and not present <= set(only)):
        raise ValueError(f"out must be new, empty or hold {what}; {folder} holds other files. Choose another name.")
    if not force:
        raise ValueError(f"out must be new or empty; {folder} holds {what}. Replace it with --force.")


def _check_parent(path: Path, argument: str) -> None:
    if not path.absolute().parent.is_dir():
        raise FileNotFoundError(f"{argument} must be in an existing folder; {path.parent} is none. Create it first.")
