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
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from secrets import token_hex
from typing import Any

import numpy as np


@dataclass(frozen=True)
class FileNames:
    """Set the names of temporary files, and of files that are named by users."""

    part: str = ".part."
    """Beginning of the names of files that are being written.

    A killed process leaves such files behind.
    """
    random_bytes: int = 8
    """Length of the random part of such a name [bytes], two digits each."""
    max_bytes: int = 150
    """Largest length of a user's name in the name of a file [bytes].

    File systems allow 255, which leaves room for endings and for names of `part_of`.
    """
    digest_digits: int = 8
    """Hexadecimal digits that keep apart names which would share a file otherwise."""

    @property
    def lock(self) -> str:
        """Return the name of the file that locks a directory."""
        return f"{self.part}lock"

    @property
    def abandoned(self) -> str:
        """Return the pattern of the names that `part_of` makes, and of no others."""
        digits = "[0-9a-f]" * (2 * self.random_bytes)
        return f"{self.part}{digits}.*"


FILE_NAMES = FileNames()

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
    """Yield a temporary path, which replaces ``path`` when the block ends.

    If the block fails, the temporary file is removed. Its name is random, so that
    several processes may write the same file; the last one stays, whole.

    Raises:
        OSError: naming the file, if it cannot be written.
    """
    with naming(path):
        _check_kind(path)
        path.parent.mkdir(parents=True, exist_ok=True)
    with naming(path), temporary(part_of(path)) as part:
        yield part
        with part.open("rb+") as file:
            # Or else the final file may be empty after a power failure.
            os.fsync(file.fileno())
        part.replace(path)


def check_writable(path: Path, directory: bool = False) -> None:
    """Check that a file, or files in a directory, can be written; change nothing.

    Raises:
        OSError: naming it.
    """
    with naming(path):
        _check_kind(path, directory)
        candidates = (path, *path.parents) if directory else path.parents
        nearest = next(place for place in candidates if place.exists())
        with temporary(part_of(path, nearest)) as part:
            part.touch()


def _check_kind(path: Path, directory: bool = False) -> None:
    """Check that a path is free, or leads to a file or directory, as wanted.

    Raises:
        OSError: if it leads to something else.
    """
    if not path.exists():
        return
    if directory and not path.is_dir():
        raise OSError("it is no directory")
    if not directory and not path.is_file():
        raise OSError("it is a directory or a device")


def part_of(path: Path, place: Path | None = None) -> Path:
    """Return a random path for the replacement of a file or directory.

    It lies beside the file or directory, or in another place.
    """
    random = token_hex(FILE_NAMES.random_bytes)
    return (place or path.parent) / f"{FILE_NAMES.part}{random}.{path.name}"


def file_name(name: str) -> str:
    """Return a file's name, without an ending, for a name of a user or from a file.

    It never leads to another directory. A name of letters, digits and ``_+@=,-`` stays
    as it is. In any other name, or in a long one, each other character becomes ``_``,
    and digits follow that depend on the whole name, so that names that differ do not
    share a file.
    """
    encoded = name.encode(errors="surrogatepass")
    # No dots, spaces or separators of paths, and no option of a command.
    is_safe = re.fullmatch(r"\w[\w+@=,-]*", name)
    if is_safe and len(encoded) <= FILE_NAMES.max_bytes:
        return name

    # Cut bytes, not characters: a character of a file's name may have four bytes.
    replaced = re.sub(r"[^\w+@=,-]", "_", name)
    first_bytes = replaced.encode()[: FILE_NAMES.max_bytes]
    shortened = first_bytes.decode(errors="ignore")
    digest = hashlib.sha256(encoded).hexdigest()[: FILE_NAMES.digest_digits]
    return f"{shortened.lstrip('+@=,-')}-{digest}"


def tidy(directory: Path) -> None:
    """Remove files that killed commands left half written in and below a directory.

    This process must have the directory `locked`.
    """
    for part in directory.rglob(FILE_NAMES.abandoned):
        _remove(part)


@contextmanager
def locked(directory: Path) -> Iterator[None]:
    """Let no other command write to a directory while the block runs.

    The directory is made, and removed if it stays empty. The lock of a killed command
    does not count, as the system has released it. On shared disks without locks, other
    commands can write to it.

    Raises:
        ValueError: if another command is writing to it.
    """
    from filelock import FileLock, Timeout

    is_new = not directory.exists()
    directory.mkdir(parents=True, exist_ok=True)
    lock_file = directory / FILE_NAMES.lock
    lock = FileLock(lock_file, timeout=0)
    try:
        try:
            lock.acquire()
        except Timeout as error:
            remedy = "wait for its end, or choose another"
            raise ValueError(
                f"another command is writing to {directory}; {remedy}"
            ) from error
        except (NotImplementedError, OSError):
            # Some shared disks have no locks.
            pass
        # Remove the file before the lock is released.
        with temporary(lock_file):
            yield
    finally:
        lock.release()
        if is_new:
            with suppress(OSError):
                directory.rmdir()


@contextmanager
def temporary(path: Path) -> Iterator[Path]:
    """Yield a file or directory, and remove it when the block ends.

    It is also removed when an interrupt ends the process.
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
    """Remove a file, a link or a directory, if there is one."""
    # This leaves files and links.
    shutil.rmtree(path, ignore_errors=True)
    with suppress(OSError):
        path.unlink(missing_ok=True)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Let errors of the system name the file that the block writes.

    The error of a full disk does not name it by itself.

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
    """Return the text of a file up to its last line break.

    What follows may be an incomplete line.

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


def write_json(file: Path, content: object) -> None:
    """Write indented JSON; the file is whole, or as it was."""
    with replacing(file) as path:
        path.write_text(json.dumps(content, indent=2) + "\n")
