"""Structures of numbers, which are read from JSON with messages that name errors, and which JAX takes as arrays."""

import re
from reprlib import repr as shortened
from typing import Annotated, Any, TypeVar

import jax
import msgspec
import numpy as np

MAX_NUMBER = 1e300

Finite = Annotated[float, msgspec.Meta(gt=-MAX_NUMBER, lt=MAX_NUMBER)]
"""A number that is neither infinite nor NaN."""

NotNegative = Annotated[float, msgspec.Meta(ge=0, lt=MAX_NUMBER)]
Positive = Annotated[float, msgspec.Meta(gt=0, lt=MAX_NUMBER)]


class Structure(msgspec.Struct, **{"frozen": True, "forbid_unknown_fields": True}):
    """Fields with types, checked by `read`."""


Kind = TypeVar("Kind")


def pytree(kind: type[Kind]) -> type[Kind]:
    """Let JAX take a structure's fields as arrays."""
    return jax.tree_util.register_dataclass(kind, kind.__struct_fields__, ())  # type: ignore[attr-defined]


def plain(structure: Kind) -> Kind:
    """Return a structure with numbers in place of its arrays, checked."""
    content = msgspec.to_builtins(structure, enc_hook=lambda array: np.asarray(array, dtype=float).tolist())
    return msgspec.convert(content, type(structure))


def read(content: Any, kind: type[Kind]) -> Kind:
    """Return the content of JSON as a structure.

    Raises:
        ValueError: naming the place, the wanted and the found value.
    """
    try:
        return msgspec.convert(content, kind)
    except msgspec.ValidationError as error:
        problem, _, path = str(error).partition(" - at `$")
        for key, place in re.findall(r"\.(\w+)|\[(\d+)\]", path.partition("[...]")[0]):
            content = content[key or int(place)]
        found = "" if problem.startswith("Object") else f" is {shortened(content)}"
        raise ValueError(f"{path.strip('.`') or 'it'}{found}: {problem}") from error
