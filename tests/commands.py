"""Commands as a user types them, in this process."""

import io
from contextlib import redirect_stderr, redirect_stdout

import pytest

from ballfg.cli.main import run
from tests.interpreter import Answer


def status(*arguments: object) -> int:
    """The exit status of a command, given as its words."""
    with pytest.raises(SystemExit) as exit_:
        run([str(argument) for argument in arguments])
    assert isinstance(exit_.value.code, int)
    return exit_.value.code


def printed(*arguments: object, status: int = 0) -> Answer:
    """What a command prints, which must end with an exit status."""
    written = io.BytesIO(), io.BytesIO()
    out, err = (io.TextIOWrapper(stream, encoding="utf-8", write_through=True) for stream in written)
    with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as exit_:
        run([str(argument) for argument in arguments])
    answer = Answer(exit_.value.code, *(stream.getvalue().decode() for stream in written))
    assert answer.status == status, answer
    return answer


def refused(*arguments: object) -> str:
    """The one line in which a command refuses its input, without a word on standard output."""
    answer = printed(*arguments, status=2)
    assert answer.out == ""
    assert answer.err.startswith("ballfg: error: ")
    assert answer.err.count("\n") == 1
    return answer.err
