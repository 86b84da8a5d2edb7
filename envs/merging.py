"""Merge configurations with the defaults key by key, and check what all environments share."""

from collections.abc import Mapping
from inspect import signature
from typing import Any

import numpy as np
from highway_env.envs.common.observation import (
    GrayscaleObservation,
    KinematicObservation,
    LidarObservation,
    OccupancyGridObservation,
)

from ms_highway.envs.checks import LARGEST, is_number, is_one_of, refuse_unknown
from ms_highway.envs.controllers import check_price
from ms_highway.envs.routes import DENSITIES
from ms_highway.game.scenario import TIME_STEP

__all__ = ["changed"]

ACTIONS: dict[str, set[str]] = {
    "Autopilot": set(),
    "HumanModelAction": {"lambda"},
    "ContinuousAction": {"acceleration_range", "steering_range", "longitudinal", "lateral", "clip"},
    "DiscreteAction": {"acceleration_range", "steering_range", "longitudinal", "lateral", "clip", "actions_per_axis"},
}
OBSERVATIONS = {
    "CarStates": None,
    "CarTracks": None,
    "Kinematics": KinematicObservation,
    "OccupancyGrid": OccupancyGridObservation,
    "LidarObservation": LidarObservation,
    "GrayscaleObservation": GrayscaleObservation,
}
CHOICES: dict[str, tuple[str | None, ...]] = {
    "semantics": ("paper", "released"),
    "influence": (None, "exact", "damped"),
    "solver": ("gradient", "newton"),
    "yielding": ("usual", "never", "always", "mixed"),
    "density": tuple(DENSITIES),
}
TIME_STEPS = 0.01, 1.0  # s, the shortest and the longest
OWN_CHECK = ("horizon", "iterations", "step_size")  # in `ms_highway.envs.settings`
REPLACED = ("human_reward",)  # mappings that are not merged: weights of two rewards do not belong together


def changed(
    defaults: Mapping[str, Any],
    changes: Mapping[str, Any] | None,
    choices: Mapping[str, tuple[str | None, ...]] | None = None,
) -> dict[str, Any]:
    """Apply changes to the defaults of any environment, and check the keys that all environments share.

    A nested mapping changes only the keys that it names, unless its ``type`` differs or it is a reward: then it
    replaces the default.

    Args:
        defaults: the whole configuration.
        changes: of some of it.
        choices: of keys whose choices differ from those of other environments.

    Raises:
        ValueError: naming the key, the value and the remedy, for anything unknown or impossible.
    """
    changes = {} if changes is None else changes
    if not isinstance(changes, Mapping):
        raise ValueError(f"the configuration is {changes!r}; it must be a dictionary")
    refuse_unknown("config", changes, defaults)
    config = {
        key: changes[key] if key in changes and key in REPLACED else _merged_value(default, changes.get(key, default))
        for key, default in defaults.items()
    }
    known = {**CHOICES, **(choices or {})}
    for key in known.keys() & config.keys():
        if not is_one_of(config[key], known[key]):
            raise ValueError(f"config[{key!r}] is {config[key]!r}; choose one of {', '.join(map(repr, known[key]))}")
    for key, default in defaults.items():
        _check_scalar(key, default, config[key])
    _set_frequencies(config, changes)
    _check_action(config["action"])
    _check_observation(config["observation"])
    return config


def _set_frequencies(config: dict[str, Any], changes: Mapping[str, Any]) -> None:
    """Let the road move, and cars act, once in every time step of the plans."""
    time_step, (shortest, longest) = config.get("time_step", TIME_STEP), TIME_STEPS
    if not shortest <= time_step <= longest:
        raise ValueError(f"config['time_step'] is {time_step!r}; it must be from {shortest:g} to {longest:g} s")
    frequency = 1 / time_step
    for key in ("simulation_frequency", "policy_frequency"):
        if key in changes and not np.isclose(config[key], frequency):
            told = f"plans are made of steps of {time_step:g} s, so it must be {frequency:g}"
            raise ValueError(f"config[{key!r}] is {config[key]!r}; {told}")
        config[key] = round(frequency) if np.isclose(frequency, round(frequency)) else frequency


def _check_scalar(key: str, default: Any, value: Any) -> None:
    """Check that a value has the type of a default that is a truth value or a number, and that numbers are positive."""
    if key in OWN_CHECK:
        return
    if isinstance(default, bool) and not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"config[{key!r}] is {value!r}; it must be True or False")
    if is_number(default) and not (is_number(value) and value > 0):
        raise ValueError(f"config[{key!r}] is {value!r}; it must be a positive number of at most {LARGEST:.2g}")


def _merged_value(default: Any, value: Any) -> Any:
    if not isinstance(default, Mapping) or not isinstance(value, Mapping):
        return value
    same_type = value.get("type", default.get("type")) == default.get("type")
    return {**default, **value} if same_type else dict(value)


def _check_type(key: str, config: Any, known: Mapping[str, Any]) -> None:
    if not isinstance(config, Mapping) or not is_one_of(config.get("type"), known):
        raise ValueError(f"config[{key!r}] is {config!r}; its 'type' must be one of {', '.join(known)}")


def _check_action(config: Mapping[str, Any]) -> None:
    _check_type("action", config, ACTIONS)
    refuse_unknown("config['action']", config, ACTIONS[config["type"]] | {"type"})
    if config["type"] == "HumanModelAction":
        check_price("config['action']", config.get("lambda"))


def _check_observation(config: Mapping[str, Any]) -> None:
    _check_type("observation", config, OBSERVATIONS)
    kind = OBSERVATIONS[config["type"]]
    options = set(signature(kind).parameters) - {"env", "kwargs"} if kind else set()
    refuse_unknown("config['observation']", config, options | {"type"})
