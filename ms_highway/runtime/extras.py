"""Import packages that only some commands need, and modules of users."""

import importlib
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager


@contextmanager
def needing(extra: str) -> Iterator[None]:
    """Let a failed import in the block name the extra of this package that installs the missing package.

    Raises:
        ImportError: naming the extra.
    """
    try:
        yield
    except ImportError as error:
        raise ImportError(f"{error}; it comes with an extra: pip install 'ms-highway[{extra}]'") from error


def import_modules(names: Sequence[str]) -> None:
    """Import the modules that a user has named, also from the current directory.

    Raises:
        ImportError: naming the module, for any error in it.
    """
    if names:
        sys.path.insert(0, os.getcwd())
    for name in names:
        try:
            importlib.import_module(name)
        except Exception as error:
            remedy = "give the name of a module that can be imported, such as brief for brief.py here"
            raise ImportError(f"--import {name}: {type(error).__name__}: {error}; {remedy}") from error
