"""In README, guide, results, notebooks, examples and docstrings, commands parse, and links and names have a target."""

import ast
import inspect
import re
import subprocess
import tomllib
from importlib import import_module
from pathlib import Path
from pkgutil import resolve_name, walk_packages

import nbformat
import pytest
from markdown_it import MarkdownIt

import ms_highway
from ms_highway.cli.main import parse

ROOT = Path(__file__).parents[2]
README, MAP, RESULTS = ROOT / "README.md", ROOT / "notebooks" / "MAP.md", ROOT / "notebooks" / "results" / "README.md"
REFERENCE = ROOT / "notebooks" / "REFERENCE.md"
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
EXAMPLES = sorted((ROOT / "notebooks" / "examples").glob("*.py"))


def prose(page: Path) -> str:
    """Return the text of a page, the text cells of a notebook, or all of an example."""
    if page.suffix != ".ipynb":
        return page.read_text()
    cells = nbformat.read(page, as_version=4).cells
    return "\n\n".join(cell.source for cell in cells if cell.cell_type == "markdown")


TEXTS = {page: prose(page) for page in (README, RESULTS, MAP, REFERENCE, *NOTEBOOKS, *EXAMPLES)}


def fences(page: Path, language: str) -> list[str]:
    """Return a page's blocks of code in a language."""
    tokens = MarkdownIt().parse(TEXTS[page])
    return [token.content for token in tokens if token.type == "fence" and token.info == language]


def commands() -> list[str]:
    """Return the lines of shell code that call ``ms-highway``, except those with variables of the shell."""
    texts = [*fences(README, "sh"), *fences(RESULTS, "sh")]
    texts += [ast.get_docstring(ast.parse(TEXTS[path])) for path in EXAMPLES]
    lines = [line.strip() for text in texts for line in text.replace("\\\n", " ").splitlines()]
    return [line for line in lines if line.startswith("ms-highway ") and "$" not in line]


@pytest.mark.parametrize("command", commands())
def test_every_command_parses(command):
    expanded = ["bash", "-c", f"printf '%s\\n' {command.partition(' > ')[0]}"]
    words = subprocess.run(expanded, capture_output=True, text=True, check=True).stdout.splitlines()
    options = parse(words[1:])
    assert callable(options.command.run)
    assert all((ROOT / f"{module.replace('.', '/')}.py").is_file() for module in options.modules)


def test_the_readme_begins_with_an_example_that_the_tests_run():
    (example,) = fences(README, "python")
    _, *statements = ast.parse(TEXTS[ROOT / "notebooks" / "examples" / "drive.py"]).body
    assert list(map(ast.dump, ast.parse(example).body)) == list(map(ast.dump, statements))


def test_every_link_has_a_target():
    dead = []
    for page in (README, RESULTS, MAP, REFERENCE, *NOTEBOOKS):
        for link in re.findall(r"\]\((?!http)([^)]*)\)", TEXTS[page]):
            place, _, anchor = link.partition("#")
            target = (page.parent / place).resolve() if place else page
            headings = re.findall(r"^#+ (.*)", TEXTS.get(target, ""), re.MULTILINE)
            anchors = [re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings]
            if not target.exists() or (anchor and anchor not in anchors):
                dead.append((page.name, link))
    assert dead == []


def test_every_file_and_name_in_a_page_exists():
    for text in TEXTS.values():
        for name in re.findall(r"`(ms_highway(?:\.\w+)+)", text):
            resolve_name(name)
    for place in re.findall(r"`([\w/]+(?:\.py|/)|tests/\w+)`", TEXTS[MAP]):
        assert (ROOT / "ms_highway" / place).exists() or (ROOT / place).exists(), place


def test_the_map_lists_all_packages_in_the_order_of_their_imports():
    (contract,) = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    assert re.findall(r"^\| `(\w+)`", TEXTS[MAP], re.MULTILINE) == contract["layers"][1:]


def test_every_name_in_a_docstring_exists():
    """Names of this package are in single backticks, other code in double ones."""
    names = [found.name for found in walk_packages(ms_highway.__path__, "ms_highway.")]
    dead = []
    for module in [import_module(name) for name in names if not name.endswith("__main__")]:
        for scope in ast.parse(inspect.getsource(module)).body:
            texts = [node.value.value for node in ast.walk(scope) if isinstance(node, ast.Expr) and is_text(node.value)]
            around = f"{module.__name__}:{scope.name}." if isinstance(scope, ast.ClassDef) else f"{module.__name__}:"
            for name in re.findall(r"(?<!`)`(\w+(?:\.\w+)*)`(?!`)", "\n".join(texts)):
                if not any(map(resolves, (name, f"{module.__name__}:{name}", around + name))):
                    dead.append(f"{module.__name__}: {name}")
    assert dead == []


def is_text(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def resolves(name: str) -> bool:
    try:
        resolve_name(name)
    except (AttributeError, ImportError, ValueError):
        return False
    return ":" in name or "." in name
