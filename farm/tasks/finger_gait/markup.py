"""MJCF texts as element trees, also those that are no XML but that MuJoCo loads."""

import xml.etree.ElementTree as ET
from html.parser import HTMLParser


def tree(text: str) -> ET.Element:
    """The first root element of a text.

    MuJoCo's reader tolerates what XML forbids: two dashes in a comment, no space between
    attributes, a bare ampersand, a superfluous end tag, something before the declaration, a second
    root. A text that is no XML is read with the same tolerance; MJCF's names have no capitals,
    which this loses.

    Raises:
      ValueError: it has no element, or one that is not closed.
    """
    try:
        return ET.fromstring(text)
    except ET.ParseError as error:
        reader = _Reader()
        reader.feed(text)
        reader.close()
        if reader.root is None or reader.open:
            raise ValueError(str(error)) from None
        return reader.root


class _Reader(HTMLParser):
    """Builds the tree of the first root element."""

    def __init__(self) -> None:
        super().__init__()
        self.root: ET.Element | None = None
        self.open: list[ET.Element] = []
        """Elements whose end tag has not come."""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = {name: value or "" for name, value in attrs}
        if self.open:
            self.open.append(ET.SubElement(self.open[-1], tag, attributes))
        elif self.root is None:
            self.root = ET.Element(tag, attributes)
            self.open = [self.root]

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        depth = len(self.open)
        self.handle_starttag(tag, attrs)
        del self.open[depth:]

    def handle_endtag(self, tag: str) -> None:
        if self.open and self.open[-1].tag == tag:
            self.open.pop()
