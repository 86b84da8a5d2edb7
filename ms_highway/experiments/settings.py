"""The settings of results, kept in a file beside them."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ms_highway.runtime.files import read_json, replacing

__all__ = ["EXTENDED", "SETTINGS_FILE", "read_settings", "write_settings"]

SETTINGS_FILE = "settings.json"

EXTENDED = ("measured", "asked")
"""Keys of the settings that further comparisons in the same directory add to: T(M), and numbers of episodes."""


def read_settings(file: Path) -> dict[str, Any]:
    """Return what a directory's results were run with.

    Raises:
        ValueError: if the file cannot be read.
    """
    try:
        return dict(read_json(file))
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(f"{file} cannot be read ({error}); choose another directory") from error


def write_settings(directory: Path, settings: Mapping[str, Any]) -> None:
    """Write the settings of a directory's results.

    Raises:
        OSError: if they cannot be written.
    """
    with replacing(directory / SETTINGS_FILE) as path:
        path.write_text(json.dumps(settings, indent=2) + "\n")
