"""The elements of a page escape what they are given; a page keeps its data apart from its scripts."""

import pytest

from ballfg.pages.html import Html, explained, table, tag, text, typed, whole_page


def test_content_and_attributes_are_escaped() -> None:
    assert tag("p", "a < b & c") == "<p>a &lt; b &amp; c</p>"
    assert tag("p", tag("b", "x")) == "<p><b>x</b></p>"
    assert (
        tag("input", kind="k", aria_label='"a" & b') == '<input class="k" aria-label="&quot;a&quot; &amp; b"></input>'
    )
    assert table(("a",), [("<",)]).count("&lt;") == 1
    assert not table(("a",), [])
    assert explained("NIS", 'its "meaning"') == '<abbr title="its &quot;meaning&quot;" tabindex="0">NIS</abbr>'


def test_numbers_are_typeset_and_commands_are_not() -> None:
    assert text("-3e-12 m/s^2") == "−3·10<sup>−12</sup> m/s²"
    assert typed("--table-height -0.02 < 1e-3") == "<code>--table-height -0.02 &lt; 1e-3</code>"


def test_data_cannot_end_their_element() -> None:
    page = whole_page("a </title> b", Html("<p>text</p>"), data={"name": "</script><script>alert(1)</script>"})
    assert page.count("</script>") == 1
    assert "<title>a &lt;/title&gt; b</title>" in page
    assert "plotly" not in page


def test_a_page_has_its_own_rules_behind_those_of_all_pages() -> None:
    page = whole_page("a", tag("h1", "a"), tag("p", "b < c"), style="main { color: red; }")
    assert page.index(":root") < page.index("main { color: red; }</style>")
    assert "<main><h1>a</h1><p>b &lt; c</p></main>" in page


def test_data_must_be_finite() -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        whole_page("a", Html(), data={"x": float("nan")})
