"""Know the files that results depend on: a user's modules, the files that these read,
and files that a user names.

Results of other content of one of these files must not stand in a table beside new
ones. So each file counts as its digest, and a directory of results keeps the digests,
see `ms_highway.experiments.directory`.
"""

import importlib
import os
import sys
import sysconfig
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from types import FrameType
from typing import TypeAlias

Sources: TypeAlias = dict[str, str]
"""Digests by the name of a module, or by the path of another file."""

DIGITS = 16
"""Hexadecimal digits of a digest, 64 bits: two versions of a file share one by no
chance.
"""

CODE = (".py", ".pyc", ".pyd", ".so")
"""Ends of files of code. Modules count by name, however Python reads them."""

PACKAGE = Path(__file__).parents[1]

STANDARD = {
    Path(sysconfig.get_path(place)).resolve() for place in ("stdlib", "platstdlib")
}
"""Directories of Python's own modules."""

INSTALLED = {"site-packages", "dist-packages"}
"""Names of directories of installed packages, also of other environments that this one
builds on.
"""

_notes: dict[
    str, Sources
] = {}  # what each module has brought that `import_modules` imported
_named: tuple[str, ...] = ()  # the modules of the last `import_modules`
_places: set[Path] = set()  # directories in which, or below, files count that are read
_code: set[str] = set()  # files of the user's modules, as frames of Python name them
_loaded: set[str] = set()  # names of all modules whose files are known
_opened: set[Path] = (
    set()
)  # files that have been opened for reading and are not known yet
_written: set[Path] = (
    set()
)  # files that have been opened for writing, such as those of a cache
_late: Sources = {}  # see `late_sources`
_imports = (
    False  # whether `import_modules` imports now; it is the user's code that reads then
)
_listens = (
    False  # whether `_note_opened` is a hook of this process; hooks stay for ever
)


def import_modules(names: Sequence[str]) -> None:
    """Import a user's modules, also from the current directory; note the modules and
    files that these load.

    Raises:
        ImportError: naming the module, for any error in it.
    """
    global _named, _imports
    _named = tuple(names)
    _late.clear()
    if not names:
        return
    sys.path.insert(0, os.getcwd())
    _places.add(Path.cwd())
    _listen()
    for name in names:
        _loaded.clear()
        _loaded.update(sys.modules)
        _opened.clear()
        _written.clear()
        _imports = True
        try:
            importlib.import_module(name)
        except Exception as error:
            remedy = (
                "give the name of a module that can be imported, such as brief for"
                " brief.py here"
            )
            raise ImportError(
                f"--import {name}: {type(error).__name__}: {error}; {remedy}"
            ) from error
        finally:
            _imports = False
        new = _new_sources()
        file = _file_of(name)
        if name in new:
            _notes[name] = {name: new[name], **new}
        elif name not in _notes and file is not None:
            _notes[name] = {name: digest(file), **new}
        # Or else it was imported before, and keeps its notes: this process goes on with
        # the code that it has loaded, whatever has happened to the file since.


def imported_sources() -> Sources:
    """Return the digests of what the modules have brought that the user has named.

    These are modules of Python outside the directories of installed packages, also
    those that other modules import; and files that were read meanwhile in the current
    directory, beside these modules and their packages, or below, except hidden ones.
    This package is left out.
    """
    return {
        name: content
        for module in _named
        for name, content in _notes.get(module, {}).items()
    }


def late_sources() -> Sources:
    """Return the digests of what was imported and read since the imports, such as in
    the first step.

    They are of the same kinds as those of `imported_sources`, all by path. Files that
    this process writes do not count.
    """
    if _named:
        for name, content in _new_sources().items():
            file = _file_of(name) if name in sys.modules else None
            _late.setdefault(os.path.relpath(file) if file else name, content)
    imported = imported_sources()
    return {name: content for name, content in _late.items() if name not in imported}


def _new_sources() -> Sources:
    """Return the digests of modules and other files that were not known yet."""
    found: Sources = {}

    # Modules, under the digest of their source. What they read may also lie beside
    # their packages.
    for name in sorted({*sys.modules} - _loaded):
        _loaded.add(name)
        file = _file_of(name)
        if file is not None:
            found[name] = digest(file)
            _code.add(str(file))
            above = file.absolute().parents
            depth = name.count(".") + (file.stem == "__init__")
            _places.add(above[min(depth, len(above) - 1)])

    # Other files, such as the weights of a driver.
    opened = {*_opened}
    _opened.difference_update(opened)
    for path in sorted(opened - _written):
        near = [
            place
            for place in _places
            if path.is_relative_to(place) and place != Path(path.anchor)
        ]
        hidden = any(
            part.startswith(".")
            for place in near
            for part in path.relative_to(place).parts
        )
        if near and not hidden and path.is_file() and is_own(path):
            found[os.path.relpath(path)] = digest(path)
    return found


def _file_of(name: str) -> Path | None:
    """Return the file of a loaded module; None for one of a package, or without a file."""
    file = Path(getattr(sys.modules[name], "__file__", None) or "")
    exists = (
        file.is_file()
    )  # packages such as PyTorch make modules that only claim a file
    return (
        file
        if exists and name.partition(".")[0] != "ms_highway" and is_own(file)
        else None
    )


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
        raise ValueError(
            f"{file} cannot be read ({reason}); name another file"
        ) from error


def package_digest() -> str:
    """Return the digest of all code and data of this package."""
    directories = (
        PACKAGE,
        PACKAGE / "envs",
    )  # a link in a checkout, which rglob does not follow
    files = {file for directory in directories for file in directory.rglob("*")}
    whole = sha256()
    for file in sorted(files):
        if file.is_file() and file.suffix != ".pyc":
            whole.update(file.relative_to(PACKAGE).as_posix().encode())
            whole.update(file.read_bytes())
    return whole.hexdigest()[:DIGITS]


def _listen() -> None:
    """Begin to note the files that Python opens."""
    global _listens
    if not _listens:
        sys.addaudithook(_note_opened)
        _listens = True


def _note_opened(event: str, arguments: tuple) -> None:
    """Note a file that Python opens; see `sys.addaudithook`."""
    if event != "open" or not _named:
        return
    path, _, flags = arguments
    if isinstance(path, (str, bytes, os.PathLike)):
        file = Path(os.fsdecode(path)).absolute()
        writes = flags & (os.O_WRONLY | os.O_RDWR)
        if writes:
            _written.add(file)
        elif file.suffix not in CODE and (_imports or _called_by_user()):
            _opened.add(file)


def _called_by_user() -> bool:
    """Return whether code of the user's is running, and not only this package, which
    reads results.
    """
    frame: FrameType | None = sys._getframe()
    while frame is not None:
        if frame.f_code.co_filename in _code:
            return True
        frame = frame.f_back
    return False


def is_own(file: Path) -> bool:
    """Return whether a file belongs neither to Python, nor to an installed package, nor
    to this one.
    """
    above = {*file.parents, *file.resolve().parents}
    installed = INSTALLED & {place.name for place in above}
    return not installed and not above & {*STANDARD, PACKAGE, PACKAGE.resolve()}
