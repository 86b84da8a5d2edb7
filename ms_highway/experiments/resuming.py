"""Resume an interrupted run: under the same settings, with the pieces that are missing.

A piece, an episode or a part of many, is either whole in the directory of results or computed again.
"""

import json
from collections.abc import Container, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from ms_highway.experiments.settings import EXTENDED, SETTINGS_FILE, read_settings
from ms_highway.runtime.files import PART

__all__ = ["cannot_resume", "check_settings", "missing", "resumed_settings"]

Piece = TypeVar("Piece")


def check_settings(directory: Path, settings: Mapping[str, Any]) -> None:
    """Check that results with these settings can begin, or be resumed, in a directory that holds nothing else.

    Raises:
        ValueError: if it is a file, or holds results of other settings, or other things.
    """
    if directory.exists() and not directory.is_dir():
        raise ValueError(f"--out is {directory}, which is a file; name a new or existing directory")
    if (directory / SETTINGS_FILE).exists():
        resumed_settings(directory, settings)
    elif directory.exists() and any(not file.name.startswith(PART) for file in directory.iterdir()):
        raise ValueError(f"{directory} is not empty, and has no {SETTINGS_FILE}; choose another directory with --out")


def resumed_settings(directory: Path, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings in a directory, which must agree with these but for the keys `EXTENDED`.

    Raises:
        ValueError: if they cannot be read or differ.
    """
    known, wanted = read_settings(directory / SETTINGS_FILE), json.loads(json.dumps(settings))
    differing = [key for key in {**known, **wanted} if key not in EXTENDED and known.get(key) != wanted.get(key)]
    if differing:
        before, now = ({key: repr(each.get(key, "the default")) for key in differing} for each in (known, wanted))
        pairs = ", ".join(f"{key} {before[key]} instead of {now[key]}" for key in differing)
        raise ValueError(f"{directory} holds results with {pairs}; choose another directory with --out")
    return known


def missing(wanted: Iterable[Piece], done: Container[Piece]) -> list[Piece]:
    """Return the pieces that are wanted and not done, each once, in the order in which they are wanted."""
    return [piece for piece in dict.fromkeys(wanted) if piece not in done]


def cannot_resume(file: Path, error: Exception, remedy: str) -> ValueError:
    """Return the error to raise from the one that a file of results has caused."""
    return ValueError(f"{file} cannot be resumed ({error}); {remedy}")
