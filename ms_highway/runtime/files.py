"""Read and write files that are either whole or absent."""

import hashlib
import json
import os
import re
import shutil
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import StringIO
from pathlib import Path
from secrets import token_hex
from typing import Any

import numpy as np

PART = ".part."
"""Beginning of the names of files that are being written, or were when a process was
killed.
"""

LOCK = f"{PART}lock"

LEFT_BEHIND = f"{PART}{'[0-9a-f]' * 16}.*"  # only names of `part_of`

SAFE_NAME = re.compile(r"\w[\w+@=,-]*")
"""Names that are names of files as they are: no dots, separators of paths or spaces,
and no option of a command.
"""

# bytes; file systems allow 255, which leaves room for endings and for names of
# `part_of`
LONGEST_NAME = 150
# hexadecimal digits that tell names apart which would otherwise give the same name of a
# file
DIGEST = 8

DAMAGES = (
    ArithmeticError,
    AttributeError,  # and TypeError: of content of other types
    EOFError,
    LookupError,
    MemoryError,  # of arrays that declare sizes beyond all memory
    OSError,
    RuntimeError,  # of archives that are encrypted, and of JSON nested too deeply
    SyntaxError,  # of XML
    TypeError,
    ValueError,
    tokenize.TokenError,  # of headers of arrays
    zipfile.BadZipFile,
    zlib.error,
)
"""Errors of readers for files that are damaged or missing."""

_temporary: set[Path] = set()  # files and directories that `temporary` will remove


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path, which replaces ``path`` when the block ends well and is
    removed when it fails.

    Its name is random, so that several processes may write the same file; the last one
    stays, whole.

    Raises:
        OSError: naming the file, if it cannot be written.
    """
    with naming(path):
        _check_kind(path)
        path.parent.mkdir(parents=True, exist_ok=True)
    with naming(path), temporary(part_of(path)) as part:
        yield part
        with part.open("rb+") as file:
            os.fsync(
                file.fileno()
            )  # or else the final file may be empty after a power failure
        part.replace(path)


def check_writable(path: Path, directory: bool = False) -> None:
    """Check that a file, or files in a directory, can be written; change nothing.

    Raises:
        OSError: naming it.
    """
    with naming(path):
        _check_kind(path, directory)
        places = (path, *path.parents) if directory else path.parents
        with temporary(
            part_of(path, next(place for place in places if place.exists()))
        ) as part:
            part.touch()


def _check_kind(path: Path, directory: bool = False) -> None:
    if path.exists() and not (path.is_dir() if directory else path.is_file()):
        raise OSError(
            "it is no directory" if directory else "it is a directory or a device"
        )


def part_of(path: Path, place: Path | None = None) -> Path:
    """Return a random name for the replacement of a file or directory, beside it or in
    another place.
    """
    return (place or path.parent) / f"{PART}{token_hex(8)}.{path.name}"


def file_name(name: str) -> str:
    """Return the name of a file for a name that comes from a user or from a file,
    without an ending.

    It never leads to another directory. A name of letters, digits and ``_+@=,-`` stays
    as it is. In any other name, or in a long one, each other character becomes ``_``,
    and digits follow that depend on the whole name, so that names that differ do not
    share a file.
    """
    encoded = name.encode(errors="surrogatepass")
    if SAFE_NAME.fullmatch(name) and len(encoded) <= LONGEST_NAME:
        return name

    # Cut bytes, not characters: a character of a file's name may have four bytes.
    replaced = re.sub(r"[^\w+@=,-]", "_", name)
    shortened = replaced.encode()[:LONGEST_NAME].decode(errors="ignore")
    digest = hashlib.sha256(encoded).hexdigest()[:DIGEST]
    return f"{shortened.lstrip('+@=,-')}-{digest}"


def tidy(directory: Path) -> None:
    """Remove files that killed commands left half written in a directory that is
    `held`, and below it.
    """
    for part in directory.rglob(LEFT_BEHIND):
        _remove(part)


@contextmanager
def held(directory: Path) -> Iterator[None]:
    """Let no other command write to a directory while the block runs; make it, and
    remove it if it stays empty.

    The lock of a killed command does not hold, as the system has released it. On shared
    disks without locks, nothing is held.

    Raises:
        ValueError: if another command is writing to it.
    """
    from filelock import FileLock, Timeout

    made = not directory.exists()
    directory.mkdir(parents=True, exist_ok=True)
    lock = FileLock(directory / LOCK, timeout=0)
    try:
        try:
            lock.acquire()
        except Timeout as error:
            remedy = "wait for its end, or choose another"
            raise ValueError(
                f"another command is writing to {directory}; {remedy}"
            ) from error
        except (NotImplementedError, OSError):  # on some shared disks
            pass
        with temporary(directory / LOCK):  # removed while it is held
            yield
    finally:
        lock.release()
        if made:
            with suppress(OSError):
                directory.rmdir()


@contextmanager
def temporary(path: Path) -> Iterator[Path]:
    """Yield a file or directory, and remove it when the block ends or an interrupt ends
    the process.
    """
    _temporary.add(path)
    try:
        yield path
    finally:
        _remove(path)
        _temporary.discard(path)


def remove_temporary() -> None:
    """Remove all files and directories that are `temporary` now."""
    for path in tuple(_temporary):
        _remove(path)


def _remove(path: Path) -> None:
    shutil.rmtree(path, ignore_errors=True)  # leaves files and links
    with suppress(OSError):
        path.unlink(missing_ok=True)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Let errors of the system name the file that the block writes; the error of a full
    disk does not by itself.

    Raises:
        OSError: naming the file, in place of any other error of the system.
    """
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise OSError(
            f"{path} cannot be written: {reason}; make that possible, or choose another"
            " place"
        ) from error


@contextmanager
def reading(path: Path, remedy: str, kind: str = "") -> Iterator[None]:
    """Let errors of a damaged or missing file, any of `DAMAGES`, name it.

    Args:
        path: of the file.
        remedy: what the user can do.
        kind: kind of the file, beginning with `` as``.

    Raises:
        ValueError: in place of any of `DAMAGES`.
    """
    try:
        yield
    except DAMAGES as error:
        raise ValueError(
            f"{path} cannot be read{kind} ({str(error).strip()}); {remedy}"
        ) from error


def read_arrays(path: Path, most: int) -> dict[str, np.ndarray]:
    """Return the arrays of a NumPy archive.

    Args:
        path: of the file.
        most: largest number of bytes that it may unpack to.

    Raises:
        ValueError: if it is no file, or unpacks to more; any other of `DAMAGES`, if it
            is damaged.
    """
    if not path.is_file():
        raise ValueError("it is missing, a directory or a device")
    with zipfile.ZipFile(path) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
    if size > most:
        raise ValueError(f"it unpacks to {size} bytes; none is larger than {most}")
    with np.load(path, allow_pickle=False) as arrays:
        return {name: np.asarray(array) for name, array in arrays.items()}


def whole_lines(path: Path) -> StringIO:
    """Return the text of a file up to its last line break: what follows may be part of
    a line.

    Raises:
        OSError: if there is no such file.
        ValueError: if it is no text.
    """
    text = path.read_text(encoding="utf-8")
    return StringIO(text[: text.rfind("\n") + 1])


def read_json(path: Path) -> Any:
    """Return the content of a JSON file.

    Raises:
        ValueError: if it is no JSON.
        OSError: if there is no such file.
    """
    return json.loads(path.read_text(encoding="utf-8"))


def write_json(file: Path, content: Any) -> None:
    """Write indented JSON; the file is whole, or as it was."""
    with replacing(file) as path:
        path.write_text(json.dumps(content, indent=2) + "\n")
