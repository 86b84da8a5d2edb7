"""What a simulation of many episodes needs of an environment: the loop that they share, and what is each one's own."""

from collections.abc import Collection, Sequence
from math import isnan
from typing import Any

import numpy as np

from ms_highway.choice.rule import Order
from ms_highway.envs.base import InteractionEnv
from ms_highway.envs.controllers import ControllerSettings, DriverSettings, OrderSettings
from ms_highway.game.random import Random
from ms_highway.loop.devices import usual_chunk
from ms_highway.loop.human_drivers import traceable
from ms_highway.loop.records import DECIDES, Episodes, Loop
from ms_highway.planning.human_models import Naive, cheapest_first, human_model

STEP = (
    *("_reset", "_drive", "_drive_robot", "step", "_simulate", "_reward", "_rewards", "_is_terminated"),
    *("_is_truncated", "episode_steps", "car_states", "success", "measure", "counted_seconds"),
)
"""Names of the methods and properties of an environment that a simulation replaces by its own code."""


def shared_loop(environment: InteractionEnv, controllers: Collection[ControllerSettings]) -> Loop:
    """Return what all episodes of an environment share, with its ladder, and an order in place of a rule.

    Args:
        environment: what is simulated.
        controllers: of the robot, whose models are known to the loop.

    Raises:
        ValueError: for costs that are to be measured, and for environments that do something of their own in a step,
            or tell the robot the true rewards.
    """
    kind, settings = type(environment), environment.settings
    if own := [name for name in STEP if getattr(kind, name) is not getattr(InteractionEnv, name)]:
        reason = f"{kind.__name__} has its own {', '.join(own)}, which a simulation does not call"
        remedy = "change its scenario, its game (in `configure`) or `draw_episode`, or use `compare`"
        raise ValueError(f"{reason}; {remedy}")
    if any(isinstance(each, DriverSettings) for each in controllers):
        raise ValueError("a function that drives the robot is not simulated; use `compare`")
    if settings.beliefs == "true":
        reason = f"{environment.scenario.name} is configured with beliefs 'true', which a simulation does not do"
        raise ValueError(f"{reason}; use `compare`")
    if settings.costs == "measured":
        remedy = "say 'shipped', or give seconds by model"
        raise ValueError(f"costs are 'measured', and a simulation cannot measure plans; {remedy}")
    used = {name for each in controllers for name in each.names()}
    used |= {Naive.name for each in controllers if each.belief and not each.chooses}
    used -= {model.name for model in settings.models}
    drivers = tuple(traceable(name, environment.game) for name in settings.drivers)
    order, others = Order(np.zeros((1, 1), np.int32), settings.models), tuple(map(human_model, cheapest_first(used)))
    return Loop(environment.game, order, others, settings.way_out, drivers=drivers, chunk=usual_chunk())


def draw_start(
    environment: InteractionEnv, loop: Loop, settings: ControllerSettings, random: Random
) -> tuple[Any, ...]:
    """Draw an episode as the environment draws it at a reset; return an episode's part of `Episodes`, in its order.

    Args:
        environment: what is simulated.
        loop: of `shared_loop`.
        settings: of the robot's controller.
        random: what is drawn from.
    """
    start, weights = environment.draw_episode(random)
    drivers, shape = environment.draw_drivers(random), (environment.episode_steps, environment.settings.humans)
    rungs = np.full(shape, DECIDES, np.int32)
    if isinstance(settings, OrderSettings):
        numbers = {model.name: number for number, model in enumerate(loop.models)}
        table = np.vectorize(numbers.get)(settings.table(*shape, random))  # type: ignore[arg-type]
        rungs[:] = table[np.minimum(np.arange(shape[0]), len(table) - 1)]
    price = np.float32(0.0 if isnan(settings.price) else settings.price)
    return start.astype(np.float32), price, rungs, loop.game.robot.weights, weights, drivers


def stack_episodes(drawn: Sequence[tuple[Any, ...]]) -> Episodes:
    """Put drawn episodes together."""
    return Episodes(*map(np.array, zip(*drawn, strict=True)))
