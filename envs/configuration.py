"""Configurations: merged with the defaults key by key, and checked before anything is built from them."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from difflib import get_close_matches
from inspect import signature
from typing import Any

import numpy as np
from highway_env.envs.common.observation import (
    GrayscaleObservation,
    KinematicObservation,
    LidarObservation,
    OccupancyGridObservation,
)
from jaxtyping import Float

from ms_highway.derivatives import Influence
from ms_highway.game import Game
from ms_highway.human_models import MODELS, HumanModel, ladder
from ms_highway.learnt import shipped
from ms_highway.reward import COMFORT, FEATURES
from ms_highway.routes import DENSITIES
from ms_highway.scenario import COMMON_WEIGHTS, PHYSICAL_LIMIT, Scenario, build_game
from ms_highway.switching import PUBLISHED_COSTS, RELEASED_TRUST_TOLERANCE, Switching

__all__ = [
    "HUMAN_REWARDS",
    "changed",
    "controller_config",
    "game_of",
    "human_weights",
    "known_costs",
    "merged",
    "switching_of",
]

CONTROLLER_KEYS = {"switching": {"type", "lambda"}, "fixed": {"type", "model"}, "schedule": {"type", "models"}}
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
CHOICES = {
    "semantics": ("paper", "released"),
    "influence": (None, "exact", "damped"),
    "solver": ("gradient", "newton"),
    "density": tuple(DENSITIES),
}
FREQUENCY = 10  # Hz
WHOLE = ("human_reward",)  # mappings that are replaced, not merged: weights of two rewards do not belong together

HUMAN_REWARDS = {"paper": "learned", "released": "published"}
"""The human's reward that belongs to each semantics."""


def controller_config(text: str) -> dict[str, Any]:
    """The configuration that a controller's short name stands for.

    These are the human models, such as ``tom``; ``switching:0.1`` with a lambda; and ``schedule:tom=6,naive``, tom for
    six steps and then naive.

    Raises:
        ValueError: if it stands for none.
    """
    name, _, rest = text.partition(":")
    config: dict[str, Any]
    if name == "switching":
        try:
            config = {"type": "switching", "lambda": float(rest)}
        except ValueError:
            raise ValueError(f"controller {text!r} needs its lambda as a number, such as switching:0.1") from None
    elif name == "schedule":
        config = {"type": "schedule", "models": _schedule(text, rest)}
    elif name in MODELS and not rest:
        config = {"type": "fixed", "model": name}
    else:
        known = f"{', '.join(MODELS)}, switching:LAMBDA and schedule:MODEL=STEPS,...,MODEL"
        raise ValueError(f"unknown controller {text!r}; the controllers are {known}")
    try:
        _check_controller(config)
    except ValueError as error:
        raise ValueError(f"controller {text!r}: {error}") from None
    return config


def _schedule(text: str, parts: str) -> list[str]:
    """The models of a schedule's short name, one per step; the last one stands once and goes on."""
    *first, last = parts.split(",")
    if "=" in last:
        raise ValueError(f"controller {text!r}: the last model goes on, so name it without steps, like naive")
    models: list[str] = []
    for part in first:
        name, _, steps = part.partition("=")
        if name not in MODELS:
            raise ValueError(f"controller {text!r}: unknown human model {name!r}; the models are {', '.join(MODELS)}")
        if not steps.isdecimal():
            raise ValueError(f"controller {text!r} does not say for how many steps; say it like schedule:tom=6,naive")
        models += [name] * int(steps)
    return [*models, last]


def merged(defaults: Mapping[str, Any], changes: Mapping[str, Any] | None) -> dict[str, Any]:
    """The configuration of an `ms_highway.envs.base.InteractionEnv`: the defaults with the changes made, checked.

    Raises:
        ValueError: naming the key, the value and the remedy, for anything unknown or impossible.
    """
    config = changed(defaults, changes)
    try:
        if isinstance(config["ladder"], str):
            raise ValueError(f"{config['ladder']!r} is one name; give a list of names")
        ladder(config["ladder"])
    except (ValueError, TypeError) as error:
        raise ValueError(f"config['ladder']: {error}") from None
    _check_controller(config["controller"])
    _check_costs(config["costs"], config["ladder"])
    _check_limit(config["control_limit"])
    _check_human_reward(config["human_reward"])
    return config


def game_of(scenario: Scenario, config: Mapping[str, Any]) -> Game:
    """The game of a scenario under a configuration that `merged` has checked."""
    paper = config["semantics"] == "paper"
    influence: Influence = config["influence"] or ("damped" if paper else "exact")
    limit = config["control_limit"] or (PHYSICAL_LIMIT if paper else "unlimited")
    return build_game(
        scenario,
        config["semantics"],
        influence,
        control_limit=None if isinstance(limit, str) else tuple(limit),
        solver=config["solver"],
        human_driving=human_weights(config),
    )


def switching_of(
    config: Mapping[str, Any], costs: Float[np.ndarray, "rungs"], price: float, models: tuple[HumanModel, ...]
) -> Switching:
    """The numbers of Algorithm 1 under a configuration that `merged` has checked, with T(M) and the ladder."""
    switching = Switching(costs, price, models)
    if config["semantics"] == "released":
        switching = replace(switching, trust_tolerance=RELEASED_TRUST_TOLERANCE)
    return switching


def known_costs(config: Mapping[str, Any]) -> Mapping[str, float] | None:
    """T(M) by model under a configuration that `merged` has checked; None where it is to be measured."""
    if config["costs"] == "measured":
        return None
    return PUBLISHED_COSTS if config["costs"] == "published" else config["costs"]


def human_weights(config: Mapping[str, Any]) -> Mapping[str, float]:
    """What the human drives for, by name, under a configuration that `merged` has checked."""
    choice = config["human_reward"]
    if choice is None:
        choice = HUMAN_REWARDS[config["semantics"]]
    if choice == "learned":
        return shipped("demonstrations").weights
    return COMMON_WEIGHTS if choice == "published" else choice


def changed(defaults: Mapping[str, Any], changes: Mapping[str, Any] | None) -> dict[str, Any]:
    """The defaults of any environment with the changes made, as far as all environments share them, checked.

    A nested mapping changes only the keys that it names, unless its ``type`` differs or it is a reward: then it
    replaces the default.

    Raises:
        ValueError: naming the key, the value and the remedy, for anything unknown or impossible.
    """
    changes = changes or {}
    _refuse_unknown("config", changes, defaults)
    config = {
        key: changes[key] if key in changes and key in WHOLE else _merged_value(default, changes.get(key, default))
        for key, default in defaults.items()
    }
    for key in CHOICES.keys() & config.keys():
        if not _is_one_of(config[key], CHOICES[key]):
            raise ValueError(f"config[{key!r}] is {config[key]!r}; choose one of {', '.join(map(repr, CHOICES[key]))}")
    for key, default in defaults.items():
        _check_scalar(key, default, config[key])
    for key in ("simulation_frequency", "policy_frequency"):
        if config[key] != FREQUENCY:
            raise ValueError(f"config[{key!r}] is {config[key]!r}; plans are made of steps of 0.1 s, so it must be 10")
    _check_action(config["action"])
    _check_observation(config["observation"])
    return config


def _check_scalar(key: str, default: Any, value: Any) -> None:
    """Where the default is a truth value or a number, the value must be one as well, and a number positive."""
    if isinstance(default, bool) and not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"config[{key!r}] is {value!r}; it must be True or False")
    if _is_number(default) and not (_is_number(value) and value > 0):
        raise ValueError(f"config[{key!r}] is {value!r}; it must be a positive number")


def _merged_value(default: Any, value: Any) -> Any:
    if not isinstance(default, Mapping) or not isinstance(value, Mapping):
        return value
    same_type = value.get("type", default.get("type")) == default.get("type")
    return {**default, **value} if same_type else dict(value)


def _refuse_unknown(place: str, given: Iterable[Any], known: Iterable[str]) -> None:
    known = sorted(known)
    for key in given:
        if key not in known:
            near = get_close_matches(str(key), known, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"the keys are {', '.join(known)}"
            raise ValueError(f"unknown key {key!r} in {place}; {hint}")


def _is_one_of(value: Any, choices: Iterable[Any]) -> bool:
    """Whether a value, of whatever type, is one of some names or None."""
    return (value is None or isinstance(value, str)) and value in choices


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float, np.number)) and not isinstance(value, bool) and bool(np.isfinite(value))


def _check_price(place: str, config: Mapping[str, Any]) -> None:
    if "lambda" not in config:
        raise ValueError(f"{place} needs 'lambda', the price of a second of planning")
    if not _is_number(config["lambda"]) or config["lambda"] < 0:
        raise ValueError(f"{place}['lambda'] is {config['lambda']!r}; it must be a number that is not negative")


def _check_controller(config: Any) -> None:
    place = "config['controller']"
    _check_type("controller", config, CONTROLLER_KEYS)
    if config["type"] == "switching" and "model" in config:
        raise ValueError(f"{place} has a 'model' but is of type 'switching'; say 'type': 'fixed' to always use a model")
    _refuse_unknown(place, config, CONTROLLER_KEYS[config["type"]])
    if config["type"] == "switching":
        _check_price(place, config)
    elif config["type"] == "schedule":
        models = config.get("models")
        if not isinstance(models, (list, tuple)) or not models or not all(_is_one_of(name, MODELS) for name in models):
            raise ValueError(f"{place}['models'] is {models!r}; give a list of human models, of {', '.join(MODELS)}")
    elif not _is_one_of(config.get("model"), MODELS):
        raise ValueError(f"{place}['model'] is {config.get('model')!r}; the human models are {', '.join(MODELS)}")


def _check_type(key: str, config: Any, known: Mapping[str, Any]) -> None:
    if not isinstance(config, Mapping) or not _is_one_of(config.get("type"), known):
        raise ValueError(f"config[{key!r}] is {config!r}; its 'type' must be one of {', '.join(known)}")


def _check_action(config: Mapping[str, Any]) -> None:
    _check_type("action", config, ACTIONS)
    _refuse_unknown("config['action']", config, ACTIONS[config["type"]] | {"type"})
    if config["type"] == "HumanModelAction":
        _check_price("config['action']", config)


def _check_observation(config: Mapping[str, Any]) -> None:
    _check_type("observation", config, OBSERVATIONS)
    kind = OBSERVATIONS[config["type"]]
    options = set(signature(kind).parameters) - {"env", "kwargs"} if kind else set()
    _refuse_unknown("config['observation']", config, options | {"type"})


def _check_costs(costs: Any, names: Iterable[str]) -> None:
    if _is_one_of(costs, ("measured",)):
        return
    if _is_one_of(costs, ("published",)):
        for name in names:
            if name not in PUBLISHED_COSTS:
                raise ValueError(f"config['costs']: no seconds of {name!r} were published; say 'measured' or give them")
        return
    remedy = "say 'published', 'measured', or give seconds by model, such as {'naive': 0.09, 'turn': 0.17, 'tom': 0.37}"
    if not isinstance(costs, Mapping):
        raise ValueError(f"config['costs'] is {costs!r}; {remedy}")
    _refuse_unknown("config['costs']", costs, MODELS)
    for name in names:
        if not _is_number(costs.get(name)) or costs[name] < 0:
            raise ValueError(f"config['costs'] has {costs.get(name)!r} seconds for {name!r}; {remedy}")


def _check_limit(limit: Any) -> None:
    if _is_one_of(limit, (None, "unlimited")):
        return
    pair = list(limit) if isinstance(limit, (list, tuple, np.ndarray)) else []
    if len(pair) != 2 or not all(_is_number(bound) and bound > 0 for bound in pair):
        raise ValueError(
            f"config['control_limit'] is {limit!r}; give None for the usual limits, 'unlimited', "
            "or two positive bounds, (omega, acceleration)"
        )


def _check_human_reward(reward: Any) -> None:
    if _is_one_of(reward, (None, *HUMAN_REWARDS.values())):
        return
    if not isinstance(reward, Mapping):
        raise ValueError(
            f"config['human_reward'] is {reward!r}; say 'learned', 'published', or give weights by name, such as "
            "{'speed': 2, 'lane_alignment': 75}; weights that were learnt are in ms_highway.learnt.load(path).weights"
        )
    _refuse_unknown("config['human_reward']", reward, (*FEATURES, *COMFORT))
    for name, weight in reward.items():
        if not _is_number(weight):
            raise ValueError(f"config['human_reward'][{name!r}] is {weight!r}; it must be a finite number")
