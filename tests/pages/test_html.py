"""The elements of a page escape what they are given; a page keeps its data apart from its scripts."""

import pytest

from ballfg.pages import Html, table, tag, term, whole_page


def test_content_and_attributes_are_escaped() -> None:
    assert tag("p", "a < b & c") == "<p>a &lt; b &amp; c</p>"
    assert tag("p", tag("b", "x")) == "<p><b>x</b></p>"
    assert (
        tag("input", kind="k", aria_label='"a" & b') == '<input class="k" aria-label="&quot;a&quot; &amp; b"></input>'
    )
    assert table(("a",), [("<",)]).count("&lt;") == 1
    assert not table(("a",), [])
    assert 'role="tooltip"' in term("NIS", "its meaning")


def test_data_cannot_end_their_element() -> None:
    page = whole_page("a </title> b", Html("<p>text</p>"), data={"name": "</script><script>alert(1)</script>"})
    assert page.count("</script>") == 1
    assert "<title>a &lt;/title&gt; b</title>" in page
    assert "plotly" not in page


def test_data_must_be_finite() -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        whole_page("a", Html(), data={"x": float("nan")})
