"""In README, guide, results, notebooks, examples and docstrings, commands parse, and
links and names have a target.
"""

import ast
import inspect
import re
import subprocess
import tomllib
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from pkgutil import resolve_name, walk_packages

import nbformat
import numpy as np
import pytest
from episodes import drive, make
from markdown_it import MarkdownIt

import ms_highway
from ms_highway.cli.main import parse
from ms_highway.loop.controller import HUMAN_DRIVERS

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "notebooks"
README = ROOT / "README.md"
MAP = PAGES / "MAP.md"
RESULTS = PAGES / "results" / "README.md"
REFERENCE = PAGES / "REFERENCE.md"
NOTEBOOKS = sorted(PAGES.glob("*.ipynb"))
EXAMPLES = {path.stem: path.read_text() for path in sorted(PAGES.glob("examples/*.py"))}


def prose(notebook):
    """Return the text cells of a notebook."""
    cells = nbformat.read(notebook, as_version=4).cells
    return "\n\n".join(cell.source for cell in cells if cell.cell_type == "markdown")


TEXTS = {page: page.read_text() for page in (README, RESULTS, MAP, REFERENCE)}
TEXTS |= {notebook: prose(notebook) for notebook in NOTEBOOKS}


def fences(page, language):
    """Return a page's blocks of code in a language."""
    tokens = MarkdownIt().parse(TEXTS[page])
    return [
        token.content
        for token in tokens
        if token.type == "fence" and token.info == language
    ]


def commands():
    """Return the lines of shell code that call ``ms-highway``, except those with
    variables of the shell.
    """
    texts = [*fences(README, "sh"), *fences(RESULTS, "sh")]
    texts += [ast.get_docstring(ast.parse(source)) for source in EXAMPLES.values()]
    lines = "\n".join(texts).replace("\\\n", " ").splitlines()
    return [
        line
        for line in map(str.strip, lines)
        if line.startswith("ms-highway ") and "$" not in line
    ]


@pytest.mark.parametrize("command", commands())
def test_every_command_parses(command):
    expanded = ["bash", "-c", f"printf '%s\\n' {command.partition(' > ')[0]}"]
    words = subprocess.run(
        expanded, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    options = parse(words[1:])
    assert callable(options.command.run)
    assert all(
        (ROOT / f"{module.replace('.', '/')}.py").is_file()
        for module in options.modules
    )


def test_the_readme_begins_with_an_example_that_the_tests_run():
    (example,) = fences(README, "python")
    _, *statements = ast.parse(EXAMPLES["drive"]).body
    assert list(map(ast.dump, ast.parse(example).body)) == list(
        map(ast.dump, statements)
    )


def test_every_link_has_a_target():
    dead = []
    for page, text in TEXTS.items():
        for link in re.findall(r"\]\((?!http)([^)]*)\)", text):
            place, _, anchor = link.partition("#")
            target = (page.parent / place).resolve() if place else page
            headings = re.findall(r"^#+ (.*)", TEXTS.get(target, ""), re.MULTILINE)
            anchors = [
                re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
                for heading in headings
            ]
            if not target.exists() or (anchor and anchor not in anchors):
                dead.append((page.name, link))
    assert dead == []


def test_texts_on_examples_name_only_what_these_have():
    for text in [*TEXTS.values(), *EXAMPLES.values()]:
        for options in re.finditer(r"examples/(\w+)\.py((?: [^`\s]+)*)", text):
            source = EXAMPLES.get(options[1], "")
            assert all(
                word in source for word in re.findall(r"--[a-z-]+", options[2])
            ), options[0]
        for part in re.split(r"\n\n|\n(?=\|)", text):  # paragraphs and rows
            sources = [
                EXAMPLES[name]
                for name in re.findall(r"examples/(\w+)\.py", part)
                if name in EXAMPLES
            ]
            named = re.findall(r"\b(?:DQN|PPO|SAC|A2C)\b", part)
            assert not sources or all(name in "".join(sources) for name in named), part


def test_every_file_and_name_in_a_page_exists():
    for name in re.findall(
        r"`(ms_highway(?:\.\w+)+)", "\n".join([*TEXTS.values(), *EXAMPLES.values()])
    ):
        resolve_name(name)
    for place in re.findall(r"`([\w/]+(?:\.py|/)|tests/\w+)`", TEXTS[MAP]):
        assert (ROOT / "ms_highway" / place).exists() or (ROOT / place).exists(), place


def test_the_map_lists_all_packages_in_import_order():
    (contract,) = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"][
        "importlinter"
    ]["contracts"]
    assert (
        re.findall(r"^\| `(\w+)`", TEXTS[MAP], re.MULTILINE) == contract["layers"][1:]
    )


def test_the_tour_of_a_step_finds_its_code():
    _, tour = TEXTS[MAP].split("## A reading room")
    stop = r"\]\(\.\./([\w/]+\.py)\):\s+((?:`[\w.]+`(?:,\s+)?)+)"
    lines = 0
    for place, names in re.findall(stop, tour):
        tree = ast.parse((ROOT / place).read_text())
        code = dict(definitions(tree))
        for name in re.findall(r"`([\w.]+)`", names):
            lines += code[name].end_lineno - code[name].lineno + 1
    assert 1000 < lines <= 1500


def test_every_exported_name_exists():
    for found in walk_packages(ms_highway.__path__, "ms_highway."):
        if found.ispkg:
            package = import_module(found.name)
            for name in getattr(package, "__all__", ()):
                resolve_name(f"{found.name}:{name}")


def definitions(tree, prefix=""):
    """Yield the functions and classes of a module, and methods, by qualified name."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield prefix + node.name, node
        if isinstance(node, ast.ClassDef):
            yield from definitions(node, f"{node.name}.")


def test_every_name_in_a_docstring_exists():
    """Names of this package are in single backticks, other code in double ones."""
    names = [found.name for found in walk_packages(ms_highway.__path__, "ms_highway.")]
    dead = []
    for module in [
        import_module(name) for name in names if not name.endswith("__main__")
    ]:
        own = f"{module.__name__}:"
        for scope in ast.parse(inspect.getsource(module)).body:
            around = f"{own}{scope.name}." if isinstance(scope, ast.ClassDef) else own
            for name in re.findall(
                r"(?<!`)`(\w+(?:\.\w+)*)`(?!`)", "\n".join(docstrings(scope))
            ):
                if not any(map(resolves, (name, own + name, around + name))):
                    dead.append(own + name)
    assert dead == []


def docstrings(scope):
    """Return all texts that are statements."""
    values = [
        getattr(node.value, "value", None)
        for node in ast.walk(scope)
        if isinstance(node, ast.Expr)
    ]
    return [value for value in values if isinstance(value, str)]


def resolves(name):
    with suppress(AttributeError, ImportError, ValueError):
        resolve_name(name)
        return ":" in name or "." in name
    return False


def test_the_guides_driver_with_a_memory_repeats_its_episode():
    (example,) = fences(MAP, "python")
    exec(example, {})
    try:
        env = make("merger-v1", human_driver="reacts")
        first = drive(env, seed=1, steps=8).states
        drive(env, seed=2, steps=8)
        np.testing.assert_array_equal(drive(env, seed=1, steps=8).states, first)
        assert first[-1, 1, 3] < first[0, 1, 3]  # it has braked
    finally:
        HUMAN_DRIVERS.pop("reacts", None)
