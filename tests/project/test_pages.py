"""README, map and page of results: short, with commands that parse and links that lead somewhere."""

import ast
import re
from pkgutil import resolve_name

import nbformat
import pytest
from markdown_it import MarkdownIt
from pages import MAP, README, RESULTS, ROOT, called, commands, fences, words

from ms_highway.cli.compare import comparison
from ms_highway.cli.main import build_parser

PAGES = [README, RESULTS, MAP]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
EXAMPLES = sorted((ROOT / "notebooks" / "examples").glob("*.py"))
LINK = re.compile(r"\]\((?!http)([^)]*)\)")


def anchors(page):
    """What a link can name in a page: its headings, as GitHub writes them."""
    tokens = MarkdownIt().parse(page.read_text())
    headings = [tokens[index + 1].content for index, token in enumerate(tokens) if token.type == "heading_open"]
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_the_readme_is_short():
    assert len(README.read_bytes()) <= 8000


def test_the_first_example_is_the_file_that_the_tests_run():
    (example,) = fences(README, "python")
    _, *statements = ast.parse((ROOT / "notebooks" / "examples" / "drive.py").read_text()).body
    assert list(map(ast.dump, ast.parse(example).body)) == list(map(ast.dump, statements))


@pytest.mark.parametrize(
    "command",
    [command for page in (README, RESULTS) for command in commands(page)]
    + [command for path in EXAMPLES for command in called(ast.get_docstring(ast.parse(path.read_text())))],
)
def test_every_command_parses(command):
    options = build_parser().parse_args(words(command))
    assert callable(options.run)
    for module in options.modules:
        assert (ROOT / f"{module.replace('.', '/')}.py").is_file()
    if words(command)[0] == "compare":
        assert comparison(options).controllers


def prose(page):
    """The text of a page, or of what is not code in a notebook."""
    if page.suffix == ".md":
        return page.read_text()
    cells = nbformat.read(page, as_version=4).cells
    return "\n\n".join(cell.source for cell in cells if cell.cell_type == "markdown")


@pytest.mark.parametrize(
    ("page", "link"), [(page, link) for page in PAGES + NOTEBOOKS for link in LINK.findall(prose(page))]
)
def test_every_link_leads_somewhere(page, link):
    place, _, anchor = link.partition("#")
    target = (page.parent / place).resolve() if place else page
    assert target.exists()
    assert not anchor or anchor in anchors(target)


@pytest.mark.parametrize("page", PAGES + NOTEBOOKS + EXAMPLES, ids=lambda path: path.name)
def test_every_name_of_the_package_in_a_page_leads_somewhere(page):
    text = prose(page) if page.suffix != ".py" else page.read_text()
    for name in re.findall(r"`(ms_highway(?:\.\w+)+)", text):
        resolve_name(name)
