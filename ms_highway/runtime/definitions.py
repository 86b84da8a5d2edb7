"""Know what the user's own functions, classes and objects do, by their names.

Results depend on them beside the settings, see `ms_highway.runtime.sources`.
"""

import re
import sys
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from inspect import getsource
from pathlib import Path
from types import CodeType, FunctionType, ModuleType

from ms_highway.runtime.sources import (
    Sources,
    digest,
    digest_of,
    imported_sources,
    is_own,
)

DEFINITION = "the definition of "
"""Beginning of the name of a source that a user has added; the added name follows."""

# Digests of what the user has added, by name.
_definitions: Sources = {}


def note_definition(name: str, added: object) -> None:
    """Note the digest of a user's function, class or object under its name.

    The digest covers the file of its module or, in a notebook, its own text with the
    variables that it uses; arguments of partial functions, defaults, variables of the
    function around it; and attributes of an object.

    Args:
        name: under which it is added.
        added: function, class or object.
    """
    # The values that belong to it: arguments of partial functions, and attributes.
    values: list[object] = []
    while isinstance(added, partial):
        values += [added.args, added.keywords]
        added = added.func
    if isinstance(added, FunctionType):
        values.append(added)
    else:
        values.append(getattr(added, "__dict__", None))

    # Its file; in a notebook, its own text.
    defined = added if hasattr(added, "__qualname__") else type(added)
    module = sys.modules.get(defined.__module__)
    file = Path(getattr(module, "__file__", None) or "")
    has_file = defined.__module__ != "__main__" and file.is_file()
    _definitions.pop(name, None)
    if not has_file or is_own(file):
        source = digest(file).encode() if has_file else _content(defined)
        _definitions[name] = digest_of(source + _content(values))


def _content(value: object, depth: int = 0) -> bytes:
    """Return bytes that differ for values that differ, as far as values tell.

    Args:
        value: any value.
        depth: number of values that it is within, such as lists within lists.
    """
    max_depth = 4
    # Number of numbers from which an array counts only by its shape, such as an agent's
    # memory of past steps.
    max_size = 10_000_000

    if depth > max_depth or isinstance(value, ModuleType):
        return b""
    if isinstance(value, (FunctionType, type)):
        return _code(value, depth)
    if isinstance(value, Mapping):
        value = list(value.items())
    if isinstance(value, (set, frozenset)):
        value = sorted(_content(part, depth + 1) for part in value)
    if isinstance(value, (list, tuple)):
        parts = [_content(part, depth + 1) for part in value]
        return b"(" + b",".join(parts) + b")"
    if hasattr(value, "__array__"):
        # Imported here, as help of commands needs no NumPy.
        import numpy as np

        # JAX's keys and some tensors cannot be converted.
        with suppress(TypeError, ValueError, RuntimeError):
            array = np.asarray(value)
            numbers = array.tobytes() if array.size < max_size else b""
            return f"{array.dtype}{array.shape}".encode() + numbers
    without_addresses = re.sub(" at 0x[0-9a-f]+", "", repr(value))
    return without_addresses.encode()


def _code(defined: FunctionType | type, depth: int) -> bytes:
    """Return the text of a function or a class, and what a function uses."""
    try:
        text = getsource(defined).encode()
    except (OSError, TypeError):
        # There is no text of functions that were typed into a prompt.
        code = getattr(defined, "__code__", None)
        text = b""
        constants: object = ()
        if isinstance(code, CodeType):
            text = code.co_code
            constants = code.co_consts
        text += _content(constants, depth + 1)
    if isinstance(defined, type):
        return text

    # Defaults, variables of a notebook, and variables of the function around this one.
    used: list[object] = [defined.__defaults__, defined.__kwdefaults__]
    if defined.__module__ == "__main__":
        variables = defined.__globals__
        names = defined.__code__.co_names
        used += [variables[name] for name in names if name in variables]
    for cell in defined.__closure__ or ():
        # An empty cell has no content.
        with suppress(ValueError):
            used.append(cell.cell_contents)
    return text + _content(used, depth + 1)


def definition_sources(text: str) -> Sources:
    """Return the digests of what the user has added, if a text has its name as a word.

    Words may have hyphens.
    """
    words = {*re.findall(r"[\w-]+", text), *re.findall(r"\w+", text)}
    return {
        DEFINITION + name: content
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
        DEFINITION + added: content for added, content in _definitions.items()
    }
    known = definitions | imported_sources()
    if name in known or name.startswith(DEFINITION):
        return known.get(name)
    return digest(Path(name))
