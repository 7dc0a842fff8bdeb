"""Checks of numbers, arrays, text and names, and the form of their messages."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from ballfg.checks import (
    as_float,
    check_array,
    check_choice,
    check_count,
    check_each,
    check_flag,
    check_instance,
    check_keys,
    check_name,
    check_number,
    check_path,
    check_range,
    check_text,
    did_you_mean,
    drawn,
    is_number,
    one_line,
    short_text,
    shown,
    visible,
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
    assert not is_number(np.timedelta64(1, "s"))
    assert as_float("k", -(10**400)) == -math.inf
    assert math.isnan(as_float("k", math.nan))
    assert check_flag("k", np.bool_(True)) is True
    check_choice("k", "a", ("a", "b"))
    assert check_path("k", "a/b") == Path("a/b")
    assert check_instance("k", 1, int, "") == 1
    assert list(check_each("k", iter((1, 2)), int, "")) == [1, 2]
    masked = np.ma.masked_array([1.0, 2.0], [False, False])
    assert type(check_array("k", masked)) is np.ndarray
    np.testing.assert_array_equal(check_array("k", torch.tensor([1.0, 2.0])), [1.0, 2.0])
    np.testing.assert_array_equal(check_array("k", [math.nan, -math.inf]), [math.nan, -math.inf])


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
            lambda: check_array("k", torch.zeros(1, requires_grad=True)),
            ValueError,
            "k must be an array of numbers; Can't call numpy() on Tensor that requires grad. Use "
            "tensor.detach().numpy() instead. Correct it.",
        ),
        (
            lambda: check_array("k", 10**400),
            ValueError,
            "k must be an array of numbers; int too large to convert to float. Correct it.",
        ),
        (lambda: check_array("k", [0.0, -1e101]), ValueError, "k must be within 1e+100; got -1e+101. Correct it."),
        (lambda: check_count("k", 0, 1), ValueError, "k must be at least 1; got 0. Choose another."),
        (
            lambda: check_choice("k", ["a"], ("a", "b")),
            ValueError,
            "k must be one of a, b; got ['a']. Choose one of them.",
        ),
        (lambda: check_flag("k", 1), TypeError, "k must be True or False; got int 1. Give one of them."),
        (lambda: check_path("k", None), TypeError, "k must be a path; got nothing None. Give it as text or Path."),
        (lambda: check_instance("k", "a", int, "Count."), TypeError, "k must be an int; got str 'a'. Count."),
        (
            lambda: check_each("k", "ab", str, ""),
            TypeError,
            "k must be a list or tuple; got str 'ab'. Put it in a list.",
        ),
        (
            lambda: list(check_each("k", [1, "a"], int, "Count.")),
            TypeError,
            "each of k must be an int; got str 'a'. Count.",
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
            "here: field 'size' is required; it is empty. Fill it.",
        ),
        (
            lambda: check_keys("here", {"name": 1}, ("size", "name"), ("size",)),
            ValueError,
            "here: field 'size' is required; got name. Add it.",
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


@pytest.mark.parametrize(
    "name", ["a", "001", "-1", "=x", "Wurf 3", "été", "球", "👩\u200d🚀", "نمونه\u200cها", "a" * 200, "<script>"]
)
def test_names(name):
    assert check_name("name", name) == name


@pytest.mark.parametrize(
    "name",
    [
        "",
        " ",
        "a" * 201,
        "a\nb",
        "a\tb",
        "\x1b[2J",
        "a\0",
        "a\u202eb",
        "a\u2066b",
        "\ufeffa",
        "a\u200bb",
        "a\u2028b",
        "\ud800",
    ],
)
def test_what_is_no_name(name):
    with pytest.raises(
        ValueError, match=r"name must be printable text of one line, 1 to 200 characters .*; got "
    ) as caught:
        check_name("name", name)
    assert str(caught.value).isprintable()


def test_text_may_have_lines_but_nothing_that_a_terminal_obeys():
    check_text("source", "one\n  two\tthree")
    for text in ("\x1b[2J", "a\u202eb", "a" * 2001):
        with pytest.raises(ValueError, match="source must be text of at most 2000 characters"):
            check_text("source", text)


@pytest.mark.parametrize("name", ["a$_^$0", "$x$", "1 $", "plain_1^2"])
def test_a_name_is_drawn_to_the_letter(name):
    """As wide as matplotlib draws it where it reads no mathematics at all."""
    canvas = FigureCanvasAgg(Figure()).get_renderer()
    escaped, raw = (
        Text(0.0, 0.0, words, figure=Figure(), parse_math=math).get_window_extent(canvas)
        for words, math in ((drawn(name), True), (name, False))
    )
    assert escaped.bounds == raw.bounds


def test_what_messages_print_is_visible():
    assert one_line(ValueError("a\x1b[2J\n\u202eb.")) == r"a\x1b[2J \u202eb"
    assert short_text("a\x07b") == r"a\x07b"
    assert visible("plain é 球") == "plain é 球"


@pytest.mark.parametrize("path", ["a\0b", "a" * 256, "/".join(["a"] * 3000)])
def test_a_path_that_no_system_has(path):
    with pytest.raises(ValueError, match="out must be a path "):
        check_path("out", path)
