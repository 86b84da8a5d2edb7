"""What tests of pages and tables share."""

import json
import shutil
from html.parser import HTMLParser

CONTROLLERS = ["naive", "switching:0.4"]
COMPARE = "compare stay_back --controllers naive switching:0.4 --out"


class Page(HTMLParser):
    """The elements of a page, which must be closed in the order in which they were opened, and its text."""

    EMPTY = ("meta", "img", "link", "br", "hr")

    def __init__(self, text):
        super().__init__()
        self.elements, self.texts, self.open = [], [], []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in self.EMPTY:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] != ["style"]:
            self.texts.append(data.strip())

    def all(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]


def with_settings(compared, directory, **changes):
    """A copy of the comparison with other settings."""
    shutil.copytree(compared, directory, ignore=shutil.ignore_patterns("*.html"))
    settings = json.loads((compared / "settings.json").read_text())
    (directory / "settings.json").write_text(json.dumps(settings | changes))
    return directory
