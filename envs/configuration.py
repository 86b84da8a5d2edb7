"""Configurations: merged with the defaults key by key, and checked before anything is built from them."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from difflib import get_close_matches
from inspect import signature
from typing import Any
from warnings import warn

import numpy as np
from highway_env.envs.common.observation import (
    GrayscaleObservation,
    KinematicObservation,
    LidarObservation,
    OccupancyGridObservation,
)
from jaxtyping import Float

from ms_highway.envs.routes import DENSITIES
from ms_highway.game.game import Game
from ms_highway.game.learned_reward import shipped
from ms_highway.game.reward import weight_names
from ms_highway.game.scenario import COMMON_WEIGHTS, PHYSICAL_LIMIT, TIME_STEP, Scenario, build_game
from ms_highway.metareasoning.switching import PUBLISHED_COSTS, RELEASED_TRUST_TOLERANCE, Switching
from ms_highway.optimization.gradient_steps import PlanningSettings, gradient_steps, longest_step
from ms_highway.optimization.second_derivatives import Influence
from ms_highway.planning.human_models import MODELS, HumanModel, ladder

__all__ = [
    "HUMAN_REWARDS",
    "PLANNING",
    "ascent_of",
    "changed",
    "controller_config",
    "draw_models",
    "game_of",
    "human_weights",
    "known_costs",
    "merged",
    "named_models",
    "switching_of",
]

CONTROLLER_KEYS = {
    "switching": {"type", "lambda"},
    "fixed": {"type", "model"},
    "schedule": {"type", "models"},
    "random": {"type", "shares"},
}
ACTIONS: dict[str, set[str]] = {
    "Autopilot": set(),
    "HumanModelAction": {"lambda"},
    "ContinuousAction": {"acceleration_range", "steering_range", "longitudinal", "lateral", "clip"},
    "DiscreteAction": {"acceleration_range", "steering_range", "longitudinal", "lateral", "clip", "actions_per_axis"},
}
STEERING_RANGE = [-0.1, 0.1]  # rad, of the front wheels: at 20 m/s, 0.1 rad turns with 8 m/s^2, what tyres hold
ACTION_DEFAULTS: dict[str, dict[str, Any]] = {
    "ContinuousAction": {"steering_range": STEERING_RANGE},
    "DiscreteAction": {"steering_range": STEERING_RANGE},
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
LONGEST_HORIZON = 100  # steps
TIME_STEPS = 0.01, 1.0  # s, the shortest and the longest
MOST_ITERATIONS = 5000  # of gradient steps: more take seconds per plan
ROUNDING = 1e-6  # how far a sum of shares may be from 1
CHOSEN = ("iterations", "step_size")  # where they are None
WHOLE = ("human_reward",)  # mappings that are replaced, not merged: weights of two rewards do not belong together

PLANNING = ("horizon", "time_step", "iterations", "step_size", "control_limit")
"""Keys that say how robot and human plan."""

HUMAN_REWARDS = {"paper": "learned", "released": "published"}
"""The human's reward that belongs to each semantics."""


MOST_DIGITS = 5  # of a number of steps


def controller_config(text: str) -> dict[str, Any]:
    """The configuration that a controller's short name stands for.

    These are the human models, such as ``tom``; ``switching:0.1`` with a lambda; ``schedule:tom=6,naive``, tom for six
    steps and then naive; and ``random:naive=0.7,tom=0.3``, for every step a model that is drawn with these shares.

    Raises:
        ValueError: if it stands for none.
    """
    name, _, rest = text.partition(":")
    config: dict[str, Any]
    if name == "switching":
        try:
            if rest != rest.strip():
                raise ValueError  # the name would have spaces or line breaks, in files too
            config = {"type": "switching", "lambda": float(rest)}
        except ValueError:
            raise ValueError(f"controller {text!r} needs its lambda as a number, such as switching:0.1") from None
    elif name == "schedule":
        config = {"type": "schedule", "models": _schedule(text, rest)}
    elif name == "random":
        config = {"type": "random", "shares": _shares(text, rest)}
    elif name in MODELS and not rest:
        config = {"type": "fixed", "model": name}
    else:
        known = f"{', '.join(MODELS)}, switching:LAMBDA, schedule:MODEL=STEPS,...,MODEL and random:MODEL=SHARE,..."
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
        if len(steps) > MOST_DIGITS:
            raise ValueError(f"controller {text!r}: no episode has {steps} steps; leave out what comes later")
        models += [name] * int(steps)
    return [*models, last]


def _shares(text: str, parts: str) -> dict[str, float]:
    """The share of each model in a random controller's short name."""
    shares: dict[str, float] = {}
    for part in parts.split(","):
        name, _, share = part.partition("=")
        try:
            number = float(share)
        except ValueError:
            raise ValueError(
                f"controller {text!r} has {part!r} where a share belongs; say it like random:naive=0.7,tom=0.3"
            ) from None
        if name in shares:
            raise ValueError(f"controller {text!r} names {name!r} twice; give it one share")
        shares[name] = number
    return shares


def named_models(controller: Mapping[str, Any]) -> list[str]:
    """The human models that a controller's configuration names; none where Algorithm 1 chooses from the ladder."""
    if controller["type"] == "fixed":
        return [controller["model"]]
    return [name for name, share in controller.get("shares", {}).items() if share > 0] or [
        *controller.get("models", [])
    ]


def draw_models(controller: Mapping[str, Any], steps: int, random: np.random.Generator) -> list[str]:
    """The human model of every step, the last of which goes on; none where Algorithm 1 chooses.

    Args:
        controller: its configuration.
        steps: how many are drawn, where the controller is a random one.
        random: what they are drawn from; other controllers leave it alone.
    """
    names = named_models(controller)
    if controller["type"] != "random":
        return names
    shares = np.array([controller["shares"][name] for name in names], dtype=float)
    return random.choice(names, size=steps, p=shares / shares.sum()).tolist()


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
    config["action"] = {**ACTION_DEFAULTS.get(config["action"]["type"], {}), **config["action"]}
    _check_ascent(config)
    if config["duration"] < config["time_step"]:
        told = f"an episode has one time step at least, {config['time_step']:g} s"
        raise ValueError(f"config['duration'] is {config['duration']!r}; {told}")
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
        planning=ascent_of(config),
    )


def ascent_of(config: Mapping[str, Any]) -> PlanningSettings:
    """How both drivers plan under a configuration that `merged` has checked."""
    iterations, step_size = config["iterations"], config["step_size"]
    return PlanningSettings(
        int(config["horizon"]),
        float(config["time_step"]),
        None if iterations is None else int(iterations),
        None if step_size is None else float(step_size),
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
    """Where the default is a truth value or a number, the value must be one as well, and a number positive."""
    if key in CHOSEN:
        return
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


def _is_whole(value: Any) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


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
    elif config["type"] == "random":
        _check_shares(f"{place}['shares']", config.get("shares"))
    elif not _is_one_of(config.get("model"), MODELS):
        raise ValueError(f"{place}['model'] is {config.get('model')!r}; the human models are {', '.join(MODELS)}")


def _check_shares(place: str, shares: Any) -> None:
    if not isinstance(shares, Mapping) or not shares:
        raise ValueError(f"{place} is {shares!r}; give the share of each model, such as {{'naive': 0.7, 'tom': 0.3}}")
    for name, share in shares.items():
        if not _is_one_of(name, MODELS):
            raise ValueError(f"{place} names {name!r}; the human models are {', '.join(MODELS)}")
        if not _is_number(share) or share < 0:
            raise ValueError(f"{place}[{name!r}] is {share!r}; a share must be a number from 0 to 1")
    if abs(sum(shares.values()) - 1) > ROUNDING:
        raise ValueError(f"{place} sum to {sum(shares.values()):g}; change one, so that they sum to 1")


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


def _check_ascent(config: Mapping[str, Any]) -> None:
    horizon, iterations, length = config["horizon"], config["iterations"], config["step_size"]
    if not _is_whole(horizon) or not 0 < horizon <= LONGEST_HORIZON:
        raise ValueError(f"config['horizon'] is {horizon!r}; it must be a whole number from 1 to {LONGEST_HORIZON}")
    if iterations is not None and not (_is_whole(iterations) and 0 < iterations <= MOST_ITERATIONS):
        told = f"it must be a whole number from 1 to {MOST_ITERATIONS}, or None"
        raise ValueError(f"config['iterations'] is {iterations!r}; {told}")
    if length is not None and not (_is_number(length) and length > 0):
        raise ValueError(f"config['step_size'] is {length!r}; it must be a positive number, or None")
    longest = longest_step(horizon, config["time_step"])
    if length is not None and length > longest:
        told = f"plans of {horizon} steps of {config['time_step']:g} s overshoot with steps longer than {longest:.2g}"
        warn(f"config['step_size'] is {length:g}: {told}; leave it out to have one chosen", stacklevel=2)
    chosen, _ = gradient_steps(ascent_of(config))
    if chosen > MOST_ITERATIONS:
        told = f"{horizon} steps of {config['time_step']:g} s need {chosen} gradient steps, which take seconds"
        raise ValueError(f"config['horizon'] is {horizon}: {told}; plan less far ahead, or give 'iterations'")


def _check_human_reward(reward: Any) -> None:
    if _is_one_of(reward, (None, *HUMAN_REWARDS.values())):
        return
    if not isinstance(reward, Mapping):
        raise ValueError(
            f"config['human_reward'] is {reward!r}; say 'learned', 'published', or give weights by name, such as "
            "{'speed': 2, 'lane_alignment': 75}; weights that were learned are in "
            "ms_highway.game.learned_reward.load(path).weights"
        )
    _refuse_unknown("config['human_reward']", reward, weight_names())
    for name, weight in reward.items():
        if not _is_number(weight):
            raise ValueError(f"config['human_reward'][{name!r}] is {weight!r}; it must be a finite number")
