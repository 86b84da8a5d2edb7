"""The documentation that docstrings make up: complete, without dead ends, and built by one command."""

import ast
import inspect
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pkgutil import resolve_name, walk_packages
from types import ModuleType

import pytest

import ms_highway

REFERENCE = re.compile(r"(?<!`)`(\w+(?:\.\w+)*)`(?!`)")
"""One name, dotted or not, in single backticks; code that is no name of this package is in double ones."""


def modules() -> Iterator[ModuleType]:
    """All modules of the package but the one that runs its command."""
    yield ms_highway
    for found in walk_packages(ms_highway.__path__, "ms_highway."):
        if not found.name.endswith("__main__"):
            yield import_module(found.name)


def docstrings(module: ModuleType) -> Iterator[tuple[str, str]]:
    """Every docstring of a module's source, those of constants too, with the name of the class around it, or ''."""
    for scope in ast.parse(inspect.getsource(module)).body:
        around = scope.name if isinstance(scope, ast.ClassDef) else ""
        for node in ast.walk(scope):
            match node:
                case ast.Expr(value=ast.Constant(value=str(text))):
                    yield around, text


def without_docstring(module: ModuleType) -> Iterator[str]:
    """The module's public functions and classes, and methods of these, that say nothing of themselves.

    A method that does what its base class says need not say it again.
    """
    tree = ast.parse(inspect.getsource(module))
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            if not ast.get_docstring(node):
                yield node.name
            for part in node.body if isinstance(node, ast.ClassDef) else []:
                if isinstance(part, ast.FunctionDef) and not part.name.startswith("_"):
                    name = f"{node.name}.{part.name}"
                    if not inspect.getdoc(resolve_name(f"{module.__name__}:{name}")):
                        yield name


def leads_somewhere(reference: str, module: ModuleType, around: str) -> bool:
    """Whether a reference names something by import, in the module, or in the class around it."""
    whole = reference if reference.startswith("ms_highway.") else f"{module.__name__}:{reference}"
    for name in (whole, f"{module.__name__}:{around}.{reference}"):
        try:
            resolve_name(name)
        except (AttributeError, ImportError, ValueError):
            continue
        return True
    return False


def test_every_reference_in_a_docstring_leads_somewhere():
    found, dead = 0, set()
    for module in modules():
        for around, text in docstrings(module):
            for match in REFERENCE.finditer(text):
                found += 1
                if not leads_somewhere(match[1], module, around):
                    dead.add(f"{module.__name__}: {match[0]}")
    assert found > 50
    assert dead == set()


def test_everything_public_has_a_docstring():
    for module in modules():
        assert module.__doc__, module.__name__
        assert list(without_docstring(module)) == [], module.__name__


@pytest.mark.slow
def test_the_documentation_is_built_without_a_warning(tmp_path):
    command = [sys.executable, "-W", "error", "-m", "pdoc", "ms_highway", "--docformat", "google", "-o", str(tmp_path)]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (built.returncode, built.stderr) == (0, "")
    for module in modules():
        assert (tmp_path / f"{module.__name__.replace('.', '/')}.html").is_file(), module.__name__
