"""Checks of single values of a configuration."""

from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any

import numpy as np

__all__ = ["LARGEST", "is_number", "is_one_of", "is_whole", "refuse_unknown"]

LARGEST = float(np.finfo(np.float32).max)
"""The largest number that single precision holds."""


def refuse_unknown(place: str, given: Iterable[Any], known: Iterable[str]) -> None:
    """Refuse keys that are not known.

    Raises:
        ValueError: naming the first one, and the nearest that is known.
    """
    known = sorted(known)
    for key in given:
        if key not in known:
            near = get_close_matches(str(key), known, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"the keys are {', '.join(known)}"
            raise ValueError(f"unknown key {key!r} in {place}; {hint}")


def is_one_of(value: Any, choices: Iterable[Any]) -> bool:
    """Return whether a value, of whatever type, is one of some names or None."""
    return (value is None or isinstance(value, str)) and value in choices


def is_whole(value: Any) -> bool:
    """Return whether a value is an integer."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def is_number(value: Any) -> bool:
    """Return whether a value is a number that single precision holds."""
    return isinstance(value, (int, float, np.number)) and not isinstance(value, bool) and bool(np.abs(value) <= LARGEST)
