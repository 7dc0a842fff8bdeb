"""Checks of numbers, arrays, text and names, and the form of their messages."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ballfg.checks import (
    check_array,
    check_count,
    check_keys,
    check_number,
    check_range,
    check_text,
    did_you_mean,
    is_number,
    short_text,
    shown,
)


def test_what_is_right_comes_back() -> None:
    assert check_number("k", np.float32(0.5), "m") == 0.5
    assert isinstance(check_number("k", 2), float)
    assert check_range("k", 1, 1, math.inf) == 1.0
    assert check_count("k", np.int64(3), 1, 3) == 3
    check_text("k", "a")
    check_text("k", None, optional=True)
    check_keys("here", {"a": 1}, ("a", "b"), ("a",))
    array = np.ones((2, 3), dtype=np.float32)
    copy = check_array("k", array, (2, 3))
    assert copy.dtype == np.float64
    assert not np.shares_memory(copy, array)
    assert not is_number(True)


@pytest.mark.parametrize(
    ("check", "error", "message"),
    [
        (lambda: check_number("k", "2"), TypeError, "k must be a number; got '2'. Write it like 0.02 or 2.0e-2."),
        (
            lambda: check_number("k", True, "m"),
            TypeError,
            "k must be a number in m; got bool True. Write it like 0.02 or 2.0e-2.",
        ),
        (lambda: check_number("k", math.nan), ValueError, "k must be finite; got nan. Correct it."),
        (
            lambda: check_number("k", 0, "Hz", above=0.0),
            ValueError,
            "k must be finite and above 0; got 0. Correct it (unit: Hz).",
        ),
        (
            lambda: check_number("k", -20, "m", limit=0.5, instead="mm"),
            ValueError,
            "k must be in m, at most 0.5; got -20. It is probably in mm: convert it to m.",
        ),
        (
            lambda: check_range("k", math.nan, 0, 1),
            ValueError,
            "k must be at least 0, at most 1; got nan. Correct it (SI units).",
        ),
        (lambda: check_range("k", -1, 0, math.inf), ValueError, "k must be at least 0; got -1. Correct it (SI units)."),
        (
            lambda: check_count("k", 1.0, 1, 3),
            TypeError,
            "k must be a whole number; got 1.0. Write it without a point.",
        ),
        (lambda: check_count("k", 4, 1, 3), ValueError, "k must lie in 1 .. 3; got 4. Choose another."),
        (lambda: check_text("k", 17), TypeError, "k must be text; got int 17. Put it in quotes."),
        (lambda: check_text("k", " "), ValueError, "k must not be empty; got ' '. Give it a text."),
        (
            lambda: check_array("k", [["a"]]),
            ValueError,
            "k must be an array of numbers; could not convert string to float: 'a'. Correct it.",
        ),
        (
            lambda: check_array("k", [1.0], (2,), "Pass two."),
            ValueError,
            "k must have shape (2,); got (1,). Pass two.",
        ),
        (
            lambda: check_keys("here", {"sise": 1}, ("size", "name"), ()),
            ValueError,
            "here: fields must be among size, name; got 'sise'. Did you mean 'size'? Rename or delete it.",
        ),
        (
            lambda: check_keys("here", {"name": 1, "size": None}, ("size", "name"), ("size",)),
            ValueError,
            "here: field 'size' is required; got name, size. Add it.",
        ),
    ],
)
def test_what_is_wrong_is_told(check: Callable[[], Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error) as caught:
        check()
    assert str(caught.value) == message


def test_a_message_shows_the_first_80_characters_of_a_value() -> None:
    assert short_text("a" * 80) == "a" * 80
    assert short_text("a" * 81) == "a" * 77 + "..."
    assert shown([1, 2.5, "a"]) == "[1, 2.5, 'a']"
    assert all(len(shown(value)) <= 80 for value in ("a" * 200, 10**200, {"a" * 50: "b" * 50}, [["a" * 30] * 30]))
    assert shown("a" * 60) == repr("a" * 60)


def test_misspelt_names() -> None:
    assert did_you_mean("Timestamp", ["x", "t"]) == " Did you mean 't'?"
    assert did_you_mean("license", ["licence"]) == " Did you mean 'licence'?"
    assert did_you_mean("zzz", ["licence"]) == ""
