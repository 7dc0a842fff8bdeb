"""What a user sees when something is wrong."""

import errno

import pytest

from ballfg.cli.errors import BAD_INPUT, guarded


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (ValueError("rate must be\npositive"), "rate must be positive"),
        (FileNotFoundError("folder must exist; x does not."), "folder must exist; x does not."),
        (OSError(errno.ENOSPC, "No space left on device"), "a file could not be read or written: No space left"),
        (PermissionError(errno.EACCES, "Permission denied", "a.csv"), "a.csv: Permission denied. Check the path"),
    ],
)
def test_what_a_user_can_mend_is_one_line(capsys, error, message):
    def command() -> None:
        raise error

    assert guarded(command) == BAD_INPUT
    said = capsys.readouterr().err
    assert said.startswith(f"ballfg: error: {message}")
    assert said.count("\n") == 1


def test_a_fault_of_the_program_keeps_its_traceback():
    def command() -> None:
        raise KeyError("x")

    with pytest.raises(KeyError):
        guarded(command)
