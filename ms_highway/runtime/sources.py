"""Know the files that results depend on.

These are a user's modules, the files that these read, and files that a user names.
Results of other content of one of these files must not stand in a table beside new
ones. So each file counts as its digest, and a directory of results keeps the digests,
see `ms_highway.experiments.directory`.
"""

import importlib
import os
import sys
import sysconfig
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from hashlib import sha256
from pathlib import Path
from types import FrameType
from typing import TypeAlias

Sources: TypeAlias = dict[str, str]
"""Digests by the name of a module, or by the path of another file."""

PACKAGE = Path(__file__).parents[1]


@dataclass
class _Watch:
    """Hold what this process knows of the user's modules, and of files that it opens.

    Attributes:
        modules: of the last `import_modules`.
        imported: what each of the modules has brought when it was imported.
        late: what has come since, see `late_sources`.
        directories: files that are read count in these directories and below.
        code: files of the user's modules, as frames of Python name them.
        known_modules: names of all modules whose files are known.
        opened: files that were opened for reading and are not known yet.
        written: files that were opened for writing, such as those of a cache.
        importing: whether `import_modules` imports now: then the user's code reads.
        listening: whether `_note_opened` is a hook of this process; hooks stay for
            ever.
    """

    modules: tuple[str, ...] = ()
    imported: dict[str, Sources] = field(default_factory=dict)
    late: Sources = field(default_factory=dict)
    directories: set[Path] = field(default_factory=set)
    code: set[str] = field(default_factory=set)
    known_modules: set[str] = field(default_factory=set)
    opened: set[Path] = field(default_factory=set)
    written: set[Path] = field(default_factory=set)
    importing: bool = False
    listening: bool = False


_watch = _Watch()


def import_modules(names: Sequence[str]) -> None:
    """Import a user's modules; note the modules and files that these load.

    Modules of the current directory can be imported, too.

    Raises:
        ImportError: naming the module, for any error in it.
    """
    _watch.modules = tuple(names)
    _watch.late.clear()
    if not names:
        return
    sys.path.insert(0, os.getcwd())
    _watch.directories.add(Path.cwd())
    _listen()
    for name in names:
        _watch.known_modules = set(sys.modules)
        _watch.opened.clear()
        _watch.written.clear()
        _watch.importing = True
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
            _watch.importing = False
        new = _new_sources()
        file = _file_of(name)
        if name in new:
            _watch.imported[name] = {name: new[name], **new}
        elif name not in _watch.imported and file is not None:
            _watch.imported[name] = {name: digest(file), **new}
        # Or else it was imported before, and keeps its notes: this process goes on with
        # the code that it has loaded, whatever has happened to the file since.


def imported_sources() -> Sources:
    """Return the digests of what the modules have brought that the user has named.

    These are modules of Python outside the directories of installed packages, also
    those that other modules import; and files that were read meanwhile in the current
    directory, beside these modules and their packages, or below, except hidden ones.
    This package is left out.
    """
    sources: Sources = {}
    for module in _watch.modules:
        sources.update(_watch.imported.get(module, {}))
    return sources


def late_sources() -> Sources:
    """Return the digests of what was imported and read after the imports.

    This may happen in the first step. They are of the same kinds as those of
    `imported_sources`, all by path. Files that this process writes do not count.
    """
    if _watch.modules:
        for name, content in _new_sources().items():
            file = _file_of(name) if name in sys.modules else None
            path = os.path.relpath(file) if file else name
            _watch.late.setdefault(path, content)
    imported = imported_sources()
    return {
        name: content for name, content in _watch.late.items() if name not in imported
    }


def _new_sources() -> Sources:
    """Return the digests of modules and other files that were not known yet."""
    found: Sources = {}

    # Modules, under the digest of their source. What they read may also lie beside
    # their packages.
    for name in sorted({*sys.modules} - _watch.known_modules):
        _watch.known_modules.add(name)
        file = _file_of(name)
        if file is not None:
            found[name] = digest(file)
            _watch.code.add(str(file))
            parents = file.absolute().parents
            depth = name.count(".") + (file.stem == "__init__")
            _watch.directories.add(parents[min(depth, len(parents) - 1)])

    # Other files, such as the weights of a driver. Take a copy of the set, as hooks may
    # add files meanwhile.
    opened = {*_watch.opened}
    _watch.opened.difference_update(opened)
    for path in sorted(opened - _watch.written):
        if _counts(path) and path.is_file() and is_own(path):
            found[os.path.relpath(path)] = digest(path)
    return found


def _counts(path: Path) -> bool:
    """Return whether a file lies below a directory that counts, and is not hidden."""
    above = []
    for directory in _watch.directories:
        is_root = directory == Path(path.anchor)
        if path.is_relative_to(directory) and not is_root:
            above.append(directory)

    for directory in above:
        parts = path.relative_to(directory).parts
        if any(part.startswith(".") for part in parts):
            return False
    return bool(above)


def _file_of(name: str) -> Path | None:
    """Return the file of a user's module that is loaded; None for other modules."""
    file = Path(getattr(sys.modules[name], "__file__", None) or "")
    top_level, _, _ = name.partition(".")
    # Packages such as PyTorch make modules that only claim a file.
    if file.is_file() and top_level != "ms_highway" and is_own(file):
        return file
    return None


def digest_of(content: bytes) -> str:
    """Return the digest of some content."""
    return _shortened(sha256(content).hexdigest())


def _shortened(hexadecimal: str) -> str:
    """Return the first 64 bits of a digest.

    Two versions of a file share them by no chance.
    """
    digits = 16
    return hexadecimal[:digits]


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
    # In a checkout, envs is a link, which rglob does not follow.
    directories = (PACKAGE, PACKAGE / "envs")
    files = {file for directory in directories for file in directory.rglob("*")}
    whole = sha256()
    for file in sorted(files):
        if file.is_file() and file.suffix != ".pyc":
            whole.update(file.relative_to(PACKAGE).as_posix().encode())
            whole.update(file.read_bytes())
    return _shortened(whole.hexdigest())


def _listen() -> None:
    """Begin to note the files that Python opens."""
    if not _watch.listening:
        sys.addaudithook(_note_opened)
        _watch.listening = True


def _note_opened(event: str, arguments: tuple) -> None:
    """Note a file that Python opens; see `sys.addaudithook`."""
    if event != "open" or not _watch.modules:
        return
    path, _, flags = arguments
    if not isinstance(path, (str, bytes, os.PathLike)):
        return
    file = Path(os.fsdecode(path)).absolute()
    writes = flags & (os.O_WRONLY | os.O_RDWR)
    if writes:
        _watch.written.add(file)
        return
    # Modules count by name, however Python reads them.
    is_code = file.suffix in (".py", ".pyc", ".pyd", ".so")
    if not is_code and (_watch.importing or _called_by_user()):
        _watch.opened.add(file)


def _called_by_user() -> bool:
    """Return whether code of the user's is running.

    Otherwise this package alone is running, which reads results.
    """
    frame: FrameType | None = sys._getframe()
    while frame is not None:
        if frame.f_code.co_filename in _watch.code:
            return True
        frame = frame.f_back
    return False


def is_own(file: Path) -> bool:
    """Return whether a file is the user's own.

    It belongs neither to Python, nor to an installed package, nor to this one.
    """
    above = {*file.parents, *file.resolve().parents}
    names = {directory.name for directory in above}
    # Directories of installed packages, also of environments that this one builds on.
    is_installed = "site-packages" in names or "dist-packages" in names
    foreign = {*_standard_library(), PACKAGE, PACKAGE.resolve()}
    return not is_installed and above.isdisjoint(foreign)


@cache
def _standard_library() -> tuple[Path, ...]:
    """Return the directories of Python's own modules."""
    names = ("stdlib", "platstdlib")
    return tuple(Path(sysconfig.get_path(name)).resolve() for name in names)
