"""Packages that only some commands need."""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def needing(extra: str) -> Iterator[None]:
    """Let a failed import in the block name the extra of this package that brings what lacks.

    Raises:
        ImportError: naming it.
    """
    try:
        yield
    except ImportError as error:
        raise ImportError(f"{error}; it comes with an extra: pip install 'ms-highway[{extra}]'") from error
