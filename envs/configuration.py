"""Read configurations; every error names the key, its value, its place and a remedy.

msgspec reads configurations into frozen structs. The annotations of their fields state
types and limits. The ``description`` of a `msgspec.Meta` is the remedy: it ends an
error such as ``config['grip'] is -1; ...``.
"""

from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from inspect import signature
from os import PathLike, fspath
from typing import Annotated, Any, Literal, TypeAlias, TypeVar, get_args, get_origin

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
Changes: TypeAlias = Mapping[str, Any]
Types: TypeAlias = Mapping[str, Mapping[str, Config]]
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
RANGES: Config = {
    **dict.fromkeys(("acceleration_range", "steering_range", "speed_range"), Range),
    **dict.fromkeys(("longitudinal", "lateral", "clip"), Any),
}
Parts = Annotated[
    list[Any], Meta(min_length=1, description="give a list of observations")
]


def keys_of(kind: type[Any]) -> Config:
    """Return the keys of one of highway-env's types of actions or observations; it does
    not restrict their values.
    """
    return dict.fromkeys({*signature(kind).parameters} - {"env", "kwargs"}, Any)


TYPES: Types = {
    "action": {
        "Autopilot": {},
        "HumanModelAction": {"lambda": Price},
        "ContinuousAction": RANGES,
        "DiscreteAction": RANGES | {"actions_per_axis": Any},
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


def refuse_unknown(place: str, given: Iterable[Any], known: Iterable[str]) -> None:
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
        if key not in known:
            near = get_close_matches(str(key), known, n=1)
            hint = (
                f"did you mean {near[0]!r}?"
                if near
                else f"the keys are {', '.join(known)}"
            )
            raise ValueError(f"unknown key {key!r} in {place}; {hint}")


def checked_seed(seed: Any) -> int | None:
    """Return a seed as Gymnasium takes it, a Python number; None stays None, for a seed
    that is drawn.

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


def read(kind: type[Kind], place: str, values: Any, strict: bool = True) -> Kind:
    """Return the values of a configuration as a struct; NumPy's numbers and arrays
    count as Python's.

    Args:
        kind: class of the struct; a ValueError of its ``__post_init__`` is passed on.
        place: where the values stand, such as ``"config['controller']"``.
        values: by key.
        strict: whether a number must not be given as a text.

    Raises:
        ValueError: for anything unknown, missing or impossible.
    """
    values = as_dictionary(place, values)
    known = {each.encode_name: each for each in fields(kind)}
    tag = kind.__struct_config__.tag_field
    refuse_unknown(place, values, [*known, tag] if tag else known)
    for key, each in known.items():
        if each.required or key in values:
            check(f"{place}[{key!r}]", values.get(key), each.type, strict)
    try:
        return convert(values, kind, strict=strict)
    except ValidationError as error:
        raise (error.__cause__ or error) from None


def as_dictionary(place: str, values: Any) -> Config:
    """Return a mapping as a dictionary of types that JSON has, see `as_json`.

    Raises:
        ValueError: for anything but a mapping.
    """
    values = as_json(values)
    if not isinstance(values, dict):
        raise ValueError(f"{place} is {values!r}; it must be a dictionary")
    return values


def as_json(values: Any) -> Any:
    """Convert values to types that JSON has: NumPy's numbers and arrays, mappings and
    paths to Python's own types.
    """
    return to_builtins(values, enc_hook=_builtin)


def _builtin(value: Any) -> Any:
    """Convert a value of NumPy, a mapping or a path; turn any other object into a text,
    which a check refuses.
    """
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    return fspath(value) if isinstance(value, PathLike) else repr(value)


def check(place: str, value: Any, annotation: Any, strict: bool = True) -> None:
    """Check the value of a key against an annotation.

    Raises:
        ValueError: with the annotation's description, its choices, or else what msgspec
            expects, as the remedy.
    """
    try:
        convert(value, annotation, strict=strict)
    except ValidationError as error:
        remedy = str(error).replace("Expected", "expected")
        if get_origin(annotation) is Literal:
            remedy = f"choose one of {', '.join(map(repr, get_args(annotation)))}"
        for each in get_args(annotation):
            if isinstance(each, Meta) and each.description:
                remedy = each.description
        raise ValueError(f"{place} is {value!r}; {remedy}") from None


def check_type(place: str, values: Any, known: Mapping[str, Config]) -> None:
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
    """Read the keys of a struct from a whole configuration, see `read`; the other keys
    are highway-env's.
    """
    return read(
        kind,
        "config",
        {each.encode_name: config[each.encode_name] for each in fields(kind)},
    )
