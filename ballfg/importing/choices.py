"""Holds a user's choices for an import, the guesses in their place, and the questions without a safe guess."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Self

from ballfg.checks import check_choice, check_instance, check_number, check_text, short_text, shown
from ballfg.importing.fall import AXES, LENGTHS, TIMES

ROLES: Final = ("t", "frame", "trajectory", "x", "y", "z", "sigma_x", "sigma_y", "sigma_z")  # of a column
_EXAMPLE: Final = "--columns t=stamp,x=X."
_NUMBERS: Final = ("table-height", "rate", "split-gap")
MAX_WHAT: Final = 900  # largest number of characters of an open question in a message
MAX_CHOICE: Final = 240  # largest number of characters of a choice in it, for three column names of usual length


class UndecidedError(ValueError):
    """An unsafe guess: its option, the possible values, and the one to go on with where further guesses are unsafe."""

    def __init__(self, what: str, option: str, choices: Sequence[str], example: str | None = None) -> None:
        self.option, self.choices = option, tuple(choices)
        self.first = first = example or (choices[0] if choices else "...")
        # with names of columns, which may be of any length
        remedy, *others = [short_text(choice, MAX_CHOICE) for choice in (first, *choices[1:4])]
        many = f" (or {', '.join(others)})" if others else ""
        super().__init__(f"{short_text(what, MAX_WHAT)}. Decide it with --{option} {remedy}{many}.")

    @property
    def arguments(self) -> str:
        """The first answer as arguments of `import_tracks`."""
        value: Any = self.first
        if self.option == "columns":
            value = dict(pair.split("=", 1) for pair in self.first.split(",") if "=" in pair)
        elif self.option in _NUMBERS:
            value = float(self.first)
        return f"{self.option.replace('-', '_')}={value!r}"

    def in_python(self) -> Self:
        """The same question, with the arguments of `import_tracks` beside the options of the command."""
        self.args = (f"{self} In Python: {short_text(self.arguments, MAX_WHAT)}.",)
        return self


class AllUndecidedError(UndecidedError):
    """Several unsafe guesses; `questions` has each, the later ones under the first values of the earlier ones."""

    def __init__(self, questions: Sequence[UndecidedError]) -> None:
        self.questions = tuple(questions)
        self.option, self.choices, self.first = questions[0].option, questions[0].choices, questions[0].first
        listed = " ".join(f"({i}) {question}" for i, question in enumerate(questions, 1))
        ValueError.__init__(self, f"{len(questions)} decisions are needed. {listed}")

    @property
    def arguments(self) -> str:
        """The first answers as arguments of `import_tracks`."""
        return ", ".join(question.arguments for question in self.questions)


@dataclass(frozen=True)
class Choices:
    """The user's choices; None for a guess. Raises: ValueError: an option with an impossible value."""

    columns: Mapping[str, str] = field(default_factory=dict)
    """Role -> name of the column."""
    length: str | None = None
    time: str | None = None
    up: str | None = None
    flip: str | None = None
    """Axis of the source whose sign is changed, for a left-handed frame."""
    table_height: float | None = None
    """m, in the new frame."""
    split_gap: float | None = None
    """s."""
    ball: str | None = None
    rate: float | None = None
    """Hz."""
    key: str | None = None
    topic: str | None = None
    name: str | None = None
    flights: bool = False
    """Cut the flights out, one track each."""

    def __post_init__(self) -> None:
        for option, choices in {"length": (*LENGTHS,), "time": (*TIMES,), "up": AXES, "flip": ("x", "y", "z")}.items():
            if getattr(self, option) is not None:
                check_choice(f"--{option}", getattr(self, option), choices)
        check_instance("--columns", self.columns, Mapping, f"Write {_EXAMPLE}")
        for role, column in self.columns.items():
            check_text(f"the column of {shown(role)} in --columns", column)
            if role not in ROLES:
                known = ", ".join(ROLES)
                raise ValueError(f"--columns must name roles among {known}; got {shown(role)}. Write {_EXAMPLE}")
        for option, number in (("rate", self.rate), ("split-gap", self.split_gap)):
            if number is not None:
                check_number(f"--{option}", number, above=0.0)
        if self.table_height is not None:
            check_number("--table-height", self.table_height, "m")
        for option in ("ball", "key", "topic", "name"):
            check_text(f"--{option}", getattr(self, option), optional=True)


def decided(choices: Choices, option: str, answer: str) -> Choices:
    """The choices with the value of one option, as typed. Raises: ValueError: an impossible value."""
    name = option.replace("-", "_")
    if name == "columns":
        return replace(choices, columns={**choices.columns, **parse_columns(answer)})
    value: str | float = float(answer) if option in _NUMBERS else answer
    known: dict[str, Any] = {name: value}
    return replace(choices, **known)


@dataclass(frozen=True)
class Guess:
    """One line of the proposal."""

    what: str
    value: str
    why: str
    sure: str  # stated, sure, likely or unsure
    option: str  # the option that changes it, as typed; empty if it cannot be changed


def parse_columns(text: str) -> dict[str, str]:
    """Role -> column from text such as "t=stamp,x=X". Raises: ValueError: another form."""
    found: dict[str, str] = {}
    for part in text.split(","):
        role, sign, column = part.partition("=")
        if not sign or not column.strip():
            raise ValueError(f"--columns must be written role=name, with commas between; got {part!r}: t=stamp,x=X.")
        found[role.strip()] = column.strip()
    return found
