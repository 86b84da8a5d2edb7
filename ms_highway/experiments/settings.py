"""The settings of results, kept beside them: results with others neither begin nor go on in the same directory."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ms_highway.runtime.files import PART, read_json, replacing

__all__ = ["GROWING", "SETTINGS_FILE", "check_settings", "read_settings", "refuse_others", "write_settings"]

SETTINGS_FILE = "settings.json"
GROWING = ("measured", "asked")  # of the settings, what comparisons in the same directory add to


def read_settings(file: Path) -> dict[str, Any]:
    """What a directory's results were run with.

    Raises:
        ValueError: if the file cannot be read.
    """
    try:
        return dict(read_json(file))
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(f"{file} cannot be read ({error}); choose another directory") from error


def write_settings(directory: Path, settings: Mapping[str, Any]) -> None:
    """Keep the settings of a directory's results."""
    with replacing(directory / SETTINGS_FILE) as path:
        path.write_text(json.dumps(settings, indent=2) + "\n")


def check_settings(directory: Path, settings: Mapping[str, Any]) -> None:
    """Look whether results with these settings can begin or go on in a directory.

    Raises:
        ValueError: if it is none, or holds results of other settings, or other things.
    """
    if directory.exists() and not directory.is_dir():
        raise ValueError(f"--out is {directory}, which is a file; name a directory, there already or not")
    if (directory / SETTINGS_FILE).exists():
        refuse_others(directory, read_settings(directory / SETTINGS_FILE), json.loads(json.dumps(settings)))
    elif directory.exists() and any(not file.name.startswith(PART) for file in directory.iterdir()):
        raise ValueError(f"{directory} is not empty, and has no {SETTINGS_FILE}; choose another directory with --out")


def refuse_others(directory: Path, known: Mapping[str, Any], settings: Mapping[str, Any]) -> None:
    """Refuse a directory whose results have settings other than those that are wanted."""
    differing = [key for key in {**known, **settings} if known.get(key) != settings.get(key)]
    if differing:
        told = ", ".join(f"{key} {known.get(key)!r} instead of {settings.get(key)!r}" for key in differing)
        raise ValueError(f"{directory} holds results with {told}; choose another directory with --out")
