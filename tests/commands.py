"""Commands as a user types them, in this process."""

import pytest

from ballfg.cli.main import run


def status(*arguments: object) -> int:
    """The exit status of a command, given as its words."""
    with pytest.raises(SystemExit) as exit_:
        run([str(argument) for argument in arguments])
    assert isinstance(exit_.value.code, int)
    return exit_.value.code
