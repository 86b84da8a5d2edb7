"""The settings of the environments of human and robot: what their configuration says, checked once."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from warnings import warn

import numpy as np

from ms_highway.envs.checks import LARGEST, is_number, is_one_of, is_whole, refuse_unknown
from ms_highway.envs.merging import changed
from ms_highway.envs.controllers import ControllerSettings, controller_settings
from ms_highway.game.game import Game
from ms_highway.game.learned_reward import shipped
from ms_highway.game.planning_settings import MOST_ITERATIONS, PlanningSettings, gradient_steps, longest_step
from ms_highway.game.reward import weight_names
from ms_highway.game.scenario import COMMON_WEIGHTS, PHYSICAL_LIMIT, Scenario, Semantics, build_game
from ms_highway.metareasoning.rule import PUBLISHED_COSTS
from ms_highway.optimization.second_derivatives import Influence
from ms_highway.optimization.solvers import Solver
from ms_highway.planning.effort import BEST, seconds_of
from ms_highway.planning.human_models import MODELS, HumanModel, human_model, is_model, ladder

__all__ = [
    "ACTION_DEFAULTS",
    "HUMAN_REWARDS",
    "PLANNING",
    "Settings",
    "merged",
    "read_costs",
    "read_human_weights",
    "read_limit",
    "read_planning",
]

PLANNING = ("horizon", "time_step", "iterations", "step_size", "control_limit", "grip")
"""Keys that say how robot and human plan."""

HUMAN_REWARDS = {"paper": "learned", "released": "published"}
"""The human's reward that belongs to each semantics."""

STEERING_RANGE = [-0.1, 0.1]  # rad, of the front wheels: at 20 m/s, 0.1 rad turns with 8 m/s^2, what tyres hold
ACTION_DEFAULTS: dict[str, dict[str, Any]] = {
    "ContinuousAction": {"steering_range": STEERING_RANGE},
    "DiscreteAction": {"steering_range": STEERING_RANGE},
}
"""What is added to highway-env's defaults of actions, by type."""
LONGEST_HORIZON = 100  # steps


@dataclass(frozen=True)
class Settings:
    """Checked settings of an `ms_highway.envs.base.InteractionEnv`, with open choices filled in.

    Attributes:
        semantics: ``paper`` or ``released``.
        controller: drives the robot, unless the agent does.
        models: the ladder.
        costs: T(M) by model [s]; None where it is to be measured.
        influence: form of the human's response.
        control_limit: bounds on plans, None for none.
        grip: the total acceleration that tyres hold [m/s^2], None where it is not looked at.
        solver: how plans are improved.
        human_weights: what the human drives for, by name.
        warm_start: whether plans start from the rest of the last one.
        planning: how far ahead, how often and by which gradient steps both plan.
    """

    semantics: Semantics
    controller: ControllerSettings
    models: tuple[HumanModel, ...]
    costs: Mapping[str, float] | None
    influence: Influence
    control_limit: tuple[float, float] | None
    grip: float | None
    solver: Solver
    human_weights: Mapping[str, float]
    warm_start: bool
    planning: PlanningSettings

    @classmethod
    def read(cls, config: Mapping[str, Any]) -> "Settings":
        """Read a whole configuration, of which `ms_highway.envs.configuration.changed` has checked the rest.

        Raises:
            ValueError: naming the key, the value and the remedy, for anything unknown or impossible.
        """
        paper = config["semantics"] == "paper"
        models, planning = _ladder(config["ladder"]), read_planning(config)
        controller = controller_settings(config["controller"])
        others = [human_model(name) for name in controller.names()]
        return cls(
            semantics=config["semantics"],
            models=models,
            controller=controller,
            costs=read_costs(config["costs"], models, others, gradient_steps(planning)[0]),
            influence=config["influence"] or ("damped" if paper else "exact"),
            control_limit=read_limit(config["control_limit"], PHYSICAL_LIMIT if paper else None),
            grip=_grip(config["grip"]),
            solver=config["solver"],
            planning=planning,
            human_weights=read_human_weights(config["human_reward"], HUMAN_REWARDS[config["semantics"]]),
            warm_start=bool(config["warm_start"]),
        )

    def game(self, scenario: Scenario) -> Game:
        """Build the game of a scenario."""
        return build_game(
            scenario,
            self.semantics,
            self.influence,
            control_limit=self.control_limit,
            grip=self.grip,
            solver=self.solver,
            human_driving=self.human_weights,
            planning=self.planning,
        )


def merged(defaults: Mapping[str, Any], changes: Mapping[str, Any] | None) -> dict[str, Any]:
    """Apply changes to the configuration of an `ms_highway.envs.base.InteractionEnv`, and check all of it.

    Raises:
        ValueError: naming the key, the value and the remedy, for anything unknown or impossible.
    """
    config = changed(defaults, changes)
    config["action"] = {**ACTION_DEFAULTS.get(config["action"]["type"], {}), **config["action"]}
    settings = Settings.read(config)
    config["ladder"], planning = [model.name for model in settings.models], settings.planning
    longest = longest_step(planning.horizon, planning.time_step)
    if planning.step_size is not None and planning.step_size > longest:
        steps = f"{planning.horizon} steps of {planning.time_step:g} s"
        why = f"plans of {steps} overshoot with steps longer than {longest:.2g}"
        warn(f"config['step_size'] is {planning.step_size:g}: {why}; leave it out to have one chosen", stacklevel=2)
    return config


def _ladder(names: Any) -> tuple[HumanModel, ...]:
    try:
        if isinstance(names, str) and names != BEST:
            raise ValueError(f"{names!r} is one name; give a list of names, or say {BEST!r}")
        return ladder(names)
    except (ValueError, TypeError) as error:
        raise ValueError(f"config['ladder']: {error}") from None


def read_costs(
    costs: Any, rungs: Sequence[HumanModel], others: Sequence[HumanModel], iterations: int
) -> Mapping[str, float] | None:
    """Return T(M) by model, also of others than the rungs as far as it is known; None where it is to be measured.

    Raises:
        ValueError: for unknown models or impossible seconds.
    """
    if is_one_of(costs, ("measured",)):
        return None
    remedy = "say 'published', 'measured', or give seconds by model, such as {'naive': 0.09, 'turn': 0.17, 'tom': 0.37}"
    given = PUBLISHED_COSTS if is_one_of(costs, ("published",)) else costs
    if not isinstance(given, Mapping):
        raise ValueError(f"config['costs'] is {costs!r}; {remedy}")
    refuse_unknown("config['costs']", given, {*MODELS, *filter(is_model, given)})
    for name, seconds in given.items():
        if not is_number(seconds) or seconds < 0:
            raise ValueError(f"config['costs'] has {seconds!s} seconds for {name!r}; {remedy}")
    known = {model.name: seconds_of(model, given, iterations) for model in (*others, *rungs)}
    for name in [model.name for model in rungs]:
        if known[name] is None and given is PUBLISHED_COSTS:
            raise ValueError(f"config['costs']: no seconds of {name!r} were published; say 'measured' or give them")
        if known[name] is None:
            raise ValueError(f"config['costs'] has no seconds for {name!r}; {remedy}")
    return {**given, **{name: seconds for name, seconds in known.items() if seconds is not None}}


def read_limit(limit: Any, usual: tuple[float, float] | None) -> tuple[float, float] | None:
    """Return the bounds on plans; None where they are unlimited.

    Raises:
        ValueError: for impossible bounds.
    """
    if is_one_of(limit, (None, "unlimited")):
        return usual if limit is None else None
    pair = tuple(limit) if isinstance(limit, (list, tuple)) or np.ndim(limit) == 1 else ()
    if len(pair) != 2 or not all(is_number(bound) and bound > 0 for bound in pair):
        raise ValueError(
            f"config['control_limit'] is {limit!r}; give None for the usual limits, 'unlimited', "
            "or two positive bounds, (omega, acceleration)"
        )
    return pair


def _grip(grip: Any) -> float | None:
    if grip is None:
        return None
    if not (is_number(grip) and grip > 0):
        remedy = "give what tyres hold in m/s^2, such as 8 on a dry road, or None for no limit"
        raise ValueError(f"config['grip'] is {grip!r}; {remedy}")
    return float(grip)


def read_planning(config: Mapping[str, Any]) -> PlanningSettings:
    """Return how far ahead, how often and by which gradient steps cars plan.

    Raises:
        ValueError: for impossible numbers.
    """
    horizon, iterations, length = config["horizon"], config["iterations"], config["step_size"]
    time_step = float(config["time_step"])
    if not is_whole(horizon) or not 0 < horizon <= LONGEST_HORIZON:
        raise ValueError(f"config['horizon'] is {horizon!r}; it must be a whole number from 1 to {LONGEST_HORIZON}")
    if iterations is not None and not (is_whole(iterations) and 0 < iterations <= MOST_ITERATIONS):
        remedy = f"it must be a whole number from 1 to {MOST_ITERATIONS}, or None"
        raise ValueError(f"config['iterations'] is {iterations!r}; {remedy}")
    if length is not None and not (is_number(length) and length > 0):
        raise ValueError(f"config['step_size'] is {length!r}; it must be a positive number, or None")
    planning = PlanningSettings(
        int(horizon),
        time_step,
        None if iterations is None else int(iterations),
        None if length is None else float(length),
    )
    chosen, _ = gradient_steps(planning)
    if chosen > MOST_ITERATIONS:
        why = f"{horizon} steps of {time_step:g} s need {chosen} gradient steps, which take seconds"
        raise ValueError(f"config['horizon'] is {horizon}: {why}; plan less far ahead, or give 'iterations'")
    if config["duration"] < time_step:
        why = f"an episode has one time step at least, {time_step:g} s"
        raise ValueError(f"config['duration'] is {config['duration']!r}; {why}")
    return planning


def read_human_weights(reward: Any, usual: str) -> Mapping[str, float]:
    """Return the weights of the human's reward, by name.

    Raises:
        ValueError: for an unknown reward or weight.
    """
    reward = usual if reward is None else reward
    if is_one_of(reward, ("learned",)):
        return shipped("demonstrations").weights
    if is_one_of(reward, ("published",)):
        return COMMON_WEIGHTS
    if not isinstance(reward, Mapping):
        raise ValueError(
            f"config['human_reward'] is {reward!r}; say 'learned', 'published', or give weights by name, such as "
            "{'speed': 2, 'lane_alignment': 75}; weights that were learned are in "
            "ms_highway.game.learned_reward.load(path).weights"
        )
    refuse_unknown("config['human_reward']", reward, weight_names())
    for name, weight in reward.items():
        if not is_number(weight):
            raise ValueError(
                f"config['human_reward'][{name!r}] is {weight!r}; it must be a finite number of at most {LARGEST:.2g}"
            )
    return reward
