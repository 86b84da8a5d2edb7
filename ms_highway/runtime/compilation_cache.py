"""Keep compiled functions on disk: only in directories that nobody else can write to, each checked when it is read.

They are machine code and run unverified. JAX finds them by a key, a digest of the program, and runs whatever is in the
file of that name: if two files are swapped, the wrong program runs. So each is stored behind a digest of its key and
content; one that does not agree is removed and compiled again.
"""

import os
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any

from jax._src import compilation_cache  # JAX has no public interface for other caches

from ms_highway.runtime.files import replacing

__all__ = ["CheckedCache", "check_owner", "use_checked_cache"]

SUFFIX = "-checked"  # JAX's own files end in -cache
DIGEST = sha256().digest_size  # bytes, at the beginning of a file
WRITABLE_BY_OTHERS = 0o022


class CheckedCache:
    """Keep compiled functions by key, in the files of a directory, in place of JAX's own cache.

    Attributes:
        path: the directory.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = self._path = Path(path)  # JAX asks for the second

    def get(self, key: str) -> bytes | None:
        """Return what was stored; None where there is nothing, or something else, which is removed."""
        file = self._file(key)
        with suppress(FileNotFoundError):
            content = file.read_bytes()
            if content[:DIGEST] == _digest(key, content[DIGEST:]):
                return content[DIGEST:]
            file.unlink()
        return None

    def put(self, key: str, value: bytes) -> None:
        """Store a compiled function."""
        with replacing(self._file(key)) as path:
            path.write_bytes(_digest(key, value) + value)

    def _file(self, key: str) -> Path:
        return self.path / f"{key}{SUFFIX}"


def _digest(key: str, value: bytes) -> bytes:
    return sha256(key.encode() + b"\n" + value).digest()


def use_checked_cache() -> None:
    """Have JAX use a `CheckedCache` wherever it is told to keep compiled functions; its own where that is impossible.

    This replaces JAX's cache in the whole process, also for functions of others, and ignores the option
    ``jax_compilation_cache_max_size``: nothing limits the size of the directory, and nothing is evicted.
    """
    jax_cache: Any = compilation_cache
    if hasattr(jax_cache, "get_file_cache"):
        jax_cache.get_file_cache = lambda path: (CheckedCache(path), path)
    jax_cache.reset_cache()


def check_owner(directory: Path) -> None:
    """Check that nobody but this user and the system's administrator can write to a directory.

    Raises:
        PermissionError: if others can, with the remedy.
    """
    if not hasattr(os, "getuid"):  # Windows
        return
    status = directory.stat()
    if status.st_uid != os.getuid():
        raise PermissionError(f"{directory} belongs to somebody else, whose machine code would run; choose your own")
    if status.st_mode & WRITABLE_BY_OTHERS:
        raise PermissionError(
            f"others may write to {directory}, and their machine code would run; change that: chmod go-w {directory}"
        )
