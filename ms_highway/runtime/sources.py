"""Know the files that results depend on: modules that a user imports, what they read, and files that are named.

Results of other content of one of these files must not stand in a table beside new ones. So each file counts as its
digest, and a directory of results keeps the digests, see `ms_highway.experiments.directory`.
"""

import importlib
import os
import re
import sys
import sysconfig
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from hashlib import sha256
from inspect import getsource
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, TypeAlias

Sources: TypeAlias = dict[str, str]
"""Digests by the name of a module, or by the path of another file."""

DIGITS = 16
"""Hexadecimal digits of a digest, 64 bits: two versions of a file share one by no chance."""

CODE = (".py", ".pyc", ".pyd", ".so")
"""Ends of files of code. Modules count by name, however Python reads them."""

MAX_DEPTH = 4
"""Largest number of steps from what is added to what counts with it, such as a function that a function uses."""

MAX_SIZE = 10_000_000
"""Number of numbers from which an array counts only by its shape, as an agent's memory of past steps."""

PACKAGE = Path(__file__).parents[1]

STANDARD = {Path(sysconfig.get_path(place)).resolve() for place in ("stdlib", "platstdlib")}
"""Directories of Python's own modules."""

INSTALLED = {"site-packages", "dist-packages"}
"""Names of directories of installed packages, also of other environments that this one builds on."""

DEFINITION = "the definition of {}"
"""Name of the source of what a user has added, by the name under which it was added."""

_notes: dict[str, Sources] = {}  # what each module has brought that `import_modules` imported
_named: tuple[str, ...] = ()  # the modules of the last `import_modules`
_definitions: Sources = {}  # of what a user has added, by name
_opened: set[Path] | None = None  # files that have been read, while imports are noted
_listens = False  # whether `_note_opened` is a hook of this process; hooks stay for ever


def import_modules(names: Sequence[str]) -> None:
    """Import the modules that a user has named, also from the current directory, and note what they bring.

    Raises:
        ImportError: naming the module, for any error in it.
    """
    global _named
    _named = tuple(names)
    if names:
        sys.path.insert(0, os.getcwd())
    for name in names:
        with _noting(name):
            try:
                importlib.import_module(name)
            except Exception as error:
                remedy = "give the name of a module that can be imported, such as brief for brief.py here"
                raise ImportError(f"--import {name}: {type(error).__name__}: {error}; {remedy}") from error


def imported_sources() -> Sources:
    """Return the digests of what the modules have brought that the user has named.

    These are modules of Python outside the directories of installed packages, also those that other modules import;
    and files that were read meanwhile in the current directory, beside these modules and their packages, or below,
    except hidden ones. This package is left out.
    """
    return {name: content for module in _named for name, content in _notes.get(module, {}).items()}


def note_definition(name: str, added: Any) -> None:
    """Note the source of what a user adds by a name, and what it holds.

    The source is the file of its module or, in a notebook, its own text with the variables
    that it uses. It holds the arguments of a partial function, defaults, what a function
    takes from the function around it, and attributes of an object.

    Args:
        name: under which it is added.
        added: function, class or object.
    """
    held: list[Any] = []
    while isinstance(added, partial):
        held += [added.args, added.keywords]
        added = added.func
    defined = added if hasattr(added, "__qualname__") else type(added)
    held.append(added if isinstance(added, FunctionType) else getattr(added, "__dict__", None))

    module = sys.modules.get(defined.__module__)
    file = Path(getattr(module, "__file__", None) or "")
    in_module = defined.__module__ != "__main__" and file.is_file()
    _definitions.pop(name, None)
    if not in_module or _is_own(file):
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

        with suppress(TypeError, ValueError, RuntimeError):  # as of JAX's keys, and tensors
            array = np.asarray(value)
            numbers = array.tobytes() if array.size < MAX_SIZE else b""
            return f"{array.dtype}{array.shape}".encode() + numbers
    return re.sub(" at 0x[0-9a-f]+", "", repr(value)).encode()


def _code(defined: Any, depth: int) -> bytes:
    """Return the text of a function or a class, and what a function uses."""
    try:
        text = getsource(defined).encode()
    except (OSError, TypeError):  # as of functions that were typed into a prompt
        text = getattr(getattr(defined, "__code__", None), "co_code", b"")
    if isinstance(defined, type):
        return text

    # Variables of a notebook, and of the function around this one.
    used: list[Any] = [defined.__defaults__, defined.__kwdefaults__]
    if defined.__module__ == "__main__":
        names = defined.__code__.co_names
        used += [defined.__globals__[name] for name in names if name in defined.__globals__]
    for cell in defined.__closure__ or ():
        with suppress(ValueError):  # it is empty
            used.append(cell.cell_contents)
    return text + _content(used, depth + 1)


def definition_sources(text: str) -> Sources:
    """Return the digests of what the user has added by names that a text has as words."""
    words = {*re.findall(r"[\w-]+", text), *re.findall(r"\w+", text)}
    return {DEFINITION.format(name): content for name, content in _definitions.items() if name in words}


def source_now(name: str) -> str | None:
    """Return the digest that a source has in this process, as on a worker of a cluster.

    Args:
        name: of a module, of a definition, or the path of a file; see `imported_sources` and `definition_sources`.

    Returns:
        The digest; None for a definition that this process lacks.

    Raises:
        ValueError: if it is none of the first two, and no file that can be read.
    """
    definitions = {DEFINITION.format(added): content for added, content in _definitions.items()}
    known = definitions | imported_sources()
    if name in known or name.startswith(DEFINITION.format("")):
        return known.get(name)
    return digest(Path(name))


def digest_of(content: bytes) -> str:
    """Return the digest of some content."""
    return sha256(content).hexdigest()[:DIGITS]


def digest(file: Path) -> str:
    """Return the digest of a file's content.

    Raises:
        ValueError: if it cannot be read.
    """
    if not file.is_file():
        raise ValueError(f"{file} is missing, a directory or a device; name a file")
    try:
        return digest_of(file.read_bytes())
    except OSError as error:
        reason = error.strerror or str(error)
        raise ValueError(f"{file} cannot be read ({reason}); name another file") from error


def package_digest() -> str:
    """Return the digest of all code and data of this package."""
    directories = (PACKAGE, PACKAGE / "envs")  # a link in a checkout, which rglob does not follow
    files = {file for directory in directories for file in directory.rglob("*")}
    whole = sha256()
    for file in sorted(files):
        if file.is_file() and file.suffix != ".pyc":
            whole.update(file.relative_to(PACKAGE).as_posix().encode())
            whole.update(file.read_bytes())
    return whole.hexdigest()[:DIGITS]


@contextmanager
def _noting(module: str) -> Iterator[None]:
    """Note what the block brings, which imports a module.

    A module that was imported before keeps its notes: this process goes on with the code that it has loaded, whatever
    has happened to the file since.
    """
    before = {*sys.modules}
    with _noting_files() as opened:
        yield
    notes = _notes.setdefault(module, {})

    # Modules, under the digest of their source. What they read may also lie beside their
    # packages, or where they run.
    directories = {Path.cwd()}
    loaded = {*sys.modules} - before
    for name in dict.fromkeys([module, *sorted(loaded)]):
        if name in notes and name not in loaded:
            continue
        file = Path(getattr(sys.modules[name], "__file__", None) or "")
        exists = file.is_file()  # packages such as PyTorch make modules that only claim a file
        if exists and name.partition(".")[0] != "ms_highway" and _is_own(file):
            notes[name] = digest(file)
            above = file.absolute().parents
            depth = name.count(".") + (file.stem == "__init__")
            directories.add(above[min(depth, len(above) - 1)])

    # Other files, such as the weights of a driver.
    for path in opened:
        near = [place for place in directories if path.is_relative_to(place) and place != Path(path.anchor)]
        hidden = any(part.startswith(".") for place in near for part in path.relative_to(place).parts)
        if near and not hidden and path.is_file() and _is_own(path):
            notes[os.path.relpath(path)] = digest(path)


@contextmanager
def _noting_files() -> Iterator[set[Path]]:
    """Note the files that are opened for reading in the block, except those of code."""
    global _opened, _listens
    if not _listens:
        sys.addaudithook(_note_opened)
        _listens = True
    opened: set[Path] = set()
    _opened = opened
    try:
        yield opened
    finally:
        _opened = None


def _note_opened(event: str, arguments: tuple) -> None:
    """Note a file that Python opens; see `sys.addaudithook`."""
    opened = _opened  # which another thread may end meanwhile
    if opened is None or event != "open":
        return
    path, _, flags = arguments
    reads = not flags & (os.O_WRONLY | os.O_RDWR)
    if reads and isinstance(path, (str, bytes, os.PathLike)):
        file = Path(os.fsdecode(path)).absolute()
        if file.suffix not in CODE:
            opened.add(file)


def _is_own(file: Path) -> bool:
    """Return whether a file belongs neither to Python, nor to an installed package, nor to this one."""
    above = {*file.parents, *file.resolve().parents}
    installed = INSTALLED & {place.name for place in above}
    return not installed and not above & {*STANDARD, PACKAGE, PACKAGE.resolve()}
