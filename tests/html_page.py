"""A page as a test reads it: its words, headings, addresses and explained words."""

from __future__ import annotations

from html.parser import HTMLParser

VOID = {"meta", "img"}
"""Elements that have no end."""


class HtmlPage(HTMLParser):
    """What a page says.

    Attributes:
        words: outside of the style.  headings: of the first two levels.
        addresses: of what the page would load.  captions: of its pictures.
        explained: word -> its meaning.
    Raises: AssertionError: an element that is not closed, or closed before one inside it.
    """

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.words: list[str] = []
        self.headings: list[str] = []
        self.addresses: list[str] = []
        self.captions: list[str] = []
        self.explained: dict[str, str] = {}
        self.title = ""
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in VOID:
            self.open.append(tag)
        if tag == "abbr":
            self.title = dict(attrs)["title"] or ""

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.words.append(data)
        if self.open and self.open[-1] in ("h1", "h2"):
            self.headings.append(data)
        if self.open and self.open[-1] == "figcaption":
            self.captions.append(data)
        if self.open and self.open[-1] == "abbr":
            self.explained[data] = self.title

    @property
    def text(self) -> str:
        """All words, with one space between them where the page has any."""
        return " ".join("".join(self.words).split())
