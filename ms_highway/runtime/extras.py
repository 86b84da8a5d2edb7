"""Import packages that only some commands need."""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def needing(extra: str) -> Iterator[None]:
    """Let a failed import in the block name the extra that installs the package.

    Raises:
        ImportError: naming the extra.
    """
    try:
        yield
    except ImportError as error:
        raise ImportError(
            f"{error}; it comes with an extra: pip install 'ms-highway[{extra}]'"
        ) from error
