"""The cells of a fragment of HTML."""

from html.parser import HTMLParser


class Cells(HTMLParser):
    """Collects the tags of a fragment and the words in each cell; an element left open or crossed is an error."""

    def __init__(self, fragment: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.words: list[str] = []
        self._open: list[str] = []
        self.feed(fragment)
        self.close()
        assert not self._open

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self._open.append(tag)
        if tag in ("td", "th", "caption", "p"):
            self.words.append("")

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        if self._open and self._open[-1] in ("td", "th", "caption", "p"):
            self.words[-1] += data
