"""Know what the user's own functions, classes and objects do, by the names under which
they were added.

Results depend on them beside the settings, see `ms_highway.runtime.sources`.
"""

import re
import sys
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from inspect import getsource
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

from ms_highway.runtime.sources import (
    Sources,
    digest,
    digest_of,
    imported_sources,
    is_own,
)

DEFINITION = "the definition of {}"
"""Name of the source of what a user has added, by the name under which it was added."""

MAX_DEPTH = 4
"""Depth to which values within values count, such as lists within lists."""

MAX_SIZE = 10_000_000
"""Number of numbers from which an array counts only by its shape, as an agent's memory
of past steps.
"""

_definitions: Sources = {}  # by name


def note_definition(name: str, added: Any) -> None:
    """Note the digest of a user's function, class or object under its name.

    The digest covers the file of its module or, in a notebook, its own text with the
    variables that it uses; arguments of partial functions, defaults, variables of the
    function around it; and attributes of an object.

    Args:
        name: under which it is added.
        added: function, class or object.
    """
    held: list[Any] = []
    while isinstance(added, partial):
        held += [added.args, added.keywords]
        added = added.func
    defined = added if hasattr(added, "__qualname__") else type(added)
    held.append(
        added if isinstance(added, FunctionType) else getattr(added, "__dict__", None)
    )

    module = sys.modules.get(defined.__module__)
    file = Path(getattr(module, "__file__", None) or "")
    in_module = defined.__module__ != "__main__" and file.is_file()
    _definitions.pop(name, None)
    if not in_module or is_own(file):
        source = digest(file).encode() if in_module else _content(defined)
        _definitions[name] = digest_of(source + _content(held))


def _content(value: Any, depth: int = 0) -> bytes:
    """Return bytes that differ for values that differ, as far as values tell."""
    if depth > MAX_DEPTH or isinstance(value, ModuleType):
        return b""
    if isinstance(value, (FunctionType, type)):
        return _code(value, depth)
    if isinstance(value, Mapping):
        value = list(value.items())
    if isinstance(value, (set, frozenset)):
        value = sorted(_content(part, depth + 1) for part in value)
    if isinstance(value, (list, tuple)):
        return b"(" + b",".join(_content(part, depth + 1) for part in value) + b")"
    if hasattr(value, "__array__"):
        import numpy as np  # help of commands needs none

        with suppress(
            TypeError, ValueError, RuntimeError
        ):  # as of JAX's keys, and tensors
            array = np.asarray(value)
            numbers = array.tobytes() if array.size < MAX_SIZE else b""
            return f"{array.dtype}{array.shape}".encode() + numbers
    return re.sub(" at 0x[0-9a-f]+", "", repr(value)).encode()


def _code(defined: Any, depth: int) -> bytes:
    """Return the text of a function or a class, and what a function uses."""
    try:
        text = getsource(defined).encode()
    except (OSError, TypeError):  # as of functions that were typed into a prompt
        code = getattr(defined, "__code__", None)
        text = getattr(code, "co_code", b"") + _content(
            getattr(code, "co_consts", ()), depth + 1
        )
    if isinstance(defined, type):
        return text

    # Variables of a notebook, and of the function around this one.
    used: list[Any] = [defined.__defaults__, defined.__kwdefaults__]
    if defined.__module__ == "__main__":
        names = defined.__code__.co_names
        used += [
            defined.__globals__[name] for name in names if name in defined.__globals__
        ]
    for cell in defined.__closure__ or ():
        with suppress(ValueError):  # it is empty
            used.append(cell.cell_contents)
    return text + _content(used, depth + 1)


def definition_sources(text: str) -> Sources:
    """Return the digests of what the user has added by names that a text has as words."""
    words = {*re.findall(r"[\w-]+", text), *re.findall(r"\w+", text)}
    return {
        DEFINITION.format(name): content
        for name, content in _definitions.items()
        if name in words
    }


def source_now(name: str) -> str | None:
    """Return the digest that a source has in this process, as on a worker of a cluster.

    Args:
        name: of a module, of a definition, or the path of a file; see
            `imported_sources` and `definition_sources`.

    Returns:
        The digest; None for a definition that this process lacks.

    Raises:
        ValueError: if it is none of the first two, and no file that can be read.
    """
    definitions = {
        DEFINITION.format(added): content for added, content in _definitions.items()
    }
    known = definitions | imported_sources()
    if name in known or name.startswith(DEFINITION.format("")):
        return known.get(name)
    return digest(Path(name))
