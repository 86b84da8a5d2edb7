"""Read configurations; every error names the key, its value, its place and a remedy.

msgspec reads configurations into frozen structs. The annotations of their fields state
types and limits. The ``description`` of a `msgspec.Meta` is the remedy: it ends an
error such as ``config['grip'] is -1; ...``.
"""

from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from inspect import signature
from os import PathLike, fspath
from typing import (
    Annotated,
    Any,
    Literal,
    TypeAlias,
    TypeVar,
    cast,
    get_args,
    get_origin,
)

import numpy as np
from highway_env.envs.common.observation import (
    GrayscaleObservation,
    KinematicObservation,
    LidarObservation,
    OccupancyGridObservation,
    TimeToCollisionObservation,
)
from msgspec import Meta, Struct, ValidationError, convert, to_builtins
from msgspec.structs import fields

from ms_highway.runtime.limits import LARGEST, Number

Config: TypeAlias = dict[str, Any]
"""Values by key, of types that JSON has."""

Changes: TypeAlias = Mapping[str, Any]
"""Values by key that a user gives; those of NumPy are converted."""

Unchecked: TypeAlias = Any
"""Annotation of a value that highway-env checks, or nobody."""

Annotation: TypeAlias = object
"""What msgspec checks a value against: a type, or `Annotated` with limits."""

Types: TypeAlias = Mapping[str, Mapping[str, dict[str, Annotation]]]
"""Kinds of spaces, their types, and the annotations of each type's keys."""

Kind = TypeVar("Kind", bound=Struct)

Price = Annotated[
    float,
    Meta(
        ge=0,
        le=LARGEST,
        description="give the price of a second of planning, such as 1.0",
    ),
]


class Ends(Struct, array_like=True, forbid_unknown_fields=True):
    """The lowest and the highest value of a range."""

    low: Number
    high: Number

    def __post_init__(self) -> None:
        if self.low >= self.high:
            raise ValueError("the lowest value comes first")


Range = Annotated[
    Ends | None,
    Meta(description="give the lowest value first, then the highest, such as [-5, 5]"),
]
Parts = Annotated[
    list[Unchecked], Meta(min_length=1, description="give a list of observations")
]

RANGES: dict[str, Annotation] = {
    "acceleration_range": Range,
    "steering_range": Range,
    "speed_range": Range,
    "longitudinal": Unchecked,
    "lateral": Unchecked,
    "clip": Unchecked,
}
"""Keys of actions that are the controls, and the annotations of their values."""


def keys_of(kind: type) -> dict[str, Annotation]:
    """Return the keys of a type of actions or observations of highway-env.

    Their values are not restricted.
    """
    return dict.fromkeys({*signature(kind).parameters} - {"env", "kwargs"}, Unchecked)


TYPES: Types = {
    "action": {
        "Autopilot": {},
        "HumanModelAction": {"lambda": Price},
        "ContinuousAction": RANGES,
        "DiscreteAction": {**RANGES, "actions_per_axis": Unchecked},
    },
    "observation": {
        "CarStates": {},
        "SceneStates": {},
        "Kinematics": keys_of(KinematicObservation),
        "OccupancyGrid": keys_of(OccupancyGridObservation),
        "LidarObservation": keys_of(LidarObservation),
        "GrayscaleObservation": keys_of(GrayscaleObservation),
        "TimeToCollision": keys_of(TimeToCollisionObservation),
        "TupleObservation": {"observation_configs": Parts},
    },
}
"""Types of actions and observations, their keys, and the annotation of each key's
values.
"""


def refuse_unknown(place: str, given: Iterable[object], known: Iterable[str]) -> None:
    """Refuse unknown keys.

    Raises:
        ValueError: for the first unknown key; it suggests the most similar known key.
            For what has no keys.
    """
    known = sorted(known)
    if not isinstance(given, Iterable):
        raise ValueError(
            f"{place} are {given!r}; give a mapping with keys out of {', '.join(known)}"
        )
    for key in given:
        if key in known:
            continue
        hint = f"the keys are {', '.join(known)}"
        similar = get_close_matches(str(key), known, n=1)
        if similar:
            hint = f"did you mean {similar[0]!r}?"
        raise ValueError(f"unknown key {key!r} in {place}; {hint}")


def checked_seed(seed: object) -> int | None:
    """Return a seed as Gymnasium takes it, a Python number.

    None stays None, for a seed that is drawn.

    Raises:
        ValueError: for anything but a whole number that is not negative.
    """
    if seed is None:
        return None
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(
            f"the seed of reset is {seed!r}; give a whole number from 0 on, or None"
        )
    return int(seed)


def read(kind: type[Kind], place: str, values: object, strict: bool = True) -> Kind:
    """Return the values of a configuration as a struct.

    NumPy's numbers and arrays count as Python's.

    Args:
        kind: class of the struct; a ValueError of its ``__post_init__`` is passed on.
        place: where the values stand, such as ``"config['controller']"``.
        values: by key.
        strict: whether a number must not be given as a text.

    Raises:
        ValueError: for anything unknown, missing or impossible.
    """
    given = as_dictionary(place, values)
    known = {field.encode_name: field for field in fields(kind)}
    tag = kind.__struct_config__.tag_field
    refuse_unknown(place, given, [*known, tag] if tag else known)
    for key, field in known.items():
        if field.required or key in given:
            check(f"{place}[{key!r}]", given.get(key), field.type, strict)
    try:
        return convert(given, kind, strict=strict)
    except ValidationError as error:
        raise (error.__cause__ or error) from None


def as_dictionary(place: str, values: object) -> Config:
    """Return a mapping as a dictionary of types that JSON has, see `as_json`.

    Raises:
        ValueError: for anything but a mapping.
    """
    converted = as_json(values)
    if not isinstance(converted, dict):
        raise ValueError(f"{place} is {converted!r}; it must be a dictionary")
    return converted


def as_json(values: object) -> Any:
    """Convert values to types that JSON has.

    NumPy's numbers and arrays, mappings and paths become Python's own types.
    """
    return to_builtins(values, enc_hook=_builtin)


def _builtin(value: object) -> object:
    """Convert a value of NumPy, a mapping or a path.

    Any other object becomes a text, which a check refuses.
    """
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    return fspath(value) if isinstance(value, PathLike) else repr(value)


def check(
    place: str,
    value: object,
    annotation: Annotation,
    strict: bool = True,
) -> None:
    """Check the value of a key against an annotation.

    Raises:
        ValueError: with the annotation's description, its choices, or else what msgspec
            expects, as the remedy.
    """
    try:
        convert(value, cast(type, annotation), strict=strict)
    except ValidationError as error:
        remedy = str(error).replace("Expected", "expected")
        if get_origin(annotation) is Literal:
            remedy = f"choose one of {', '.join(map(repr, get_args(annotation)))}"
        for each in get_args(annotation):
            if isinstance(each, Meta) and each.description:
                remedy = each.description
        raise ValueError(f"{place} is {value!r}; {remedy}") from None


def check_type(
    place: str,
    values: object,
    known: Mapping[str, dict[str, Annotation]],
) -> None:
    """Check an action or observation type, with the parts of a ``TupleObservation``.

    Raises:
        ValueError: for an unknown type or key, or an impossible value.
    """
    if not isinstance(values, dict) or values.get("type") not in list(known):
        raise ValueError(
            f"{place} is {values!r}; its 'type' must be one of {', '.join(known)}"
        )
    keys = known[values["type"]]
    refuse_unknown(place, values, ["type", *keys])
    for key, annotation in keys.items():
        check(f"{place}[{key!r}]", values.get(key), annotation)
    for number, part in enumerate(values.get("observation_configs", ())):
        check_type(f"{place}['observation_configs'][{number}]", part, known)


def read_own(kind: type[Kind], config: Changes) -> Kind:
    """Read the keys of a struct from a whole configuration, see `read`.

    The other keys are highway-env's.
    """
    names = [field.encode_name for field in fields(kind)]
    return read(kind, "config", {name: config[name] for name in names})
