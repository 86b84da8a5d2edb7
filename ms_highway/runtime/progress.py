"""Report the progress of long computations."""

from collections.abc import Callable
from typing import TypeAlias

Progress: TypeAlias = Callable[[str], object]
"""Called with a message when a part of a computation begins."""


def silent(message: str) -> None:
    """Report nothing."""
