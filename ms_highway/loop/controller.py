"""Define controllers and the records of their steps; drive humans by functions of the state instead of plans.

Controllers take and return float64 NumPy states and controls in SI units. They drive car 0; the next cars are its
partners. Two functions of the package drive humans: one who never yields, and one who always yields.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from time import perf_counter
from typing import Any, Protocol, TypeAlias

import jax
import numpy as np
from highway_env.vehicle.kinematics import Vehicle
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.choice.rule import highest_gains
from ms_highway.game.dynamics import facing, keep_velocity
from ms_highway.game.game import Game, swap_roles
from ms_highway.loop.step import Status
from ms_highway.planning.ladders import cheapest_first
from ms_highway.runtime.arrays import Belief, Control, Controls, Gains, HumansControls, SameArray, State


@dataclass(frozen=True)
class ControlStep:
    """Record of one step of a controller.

    Attributes:
        control: to execute now, ``(omega, acceleration)``.
        plan: controls over the horizon; fewer where only part of the last plan is left.
        humans: controls that the plan expects of every human.
        models: for every human, the name of the model that predicted it in this plan.
        planning_seconds: wall time of the plan and of the check of its way out, without compilation.
        decision_seconds: wall time of choosing the models, with the belief, without compilation; 0 if nothing is chosen
            or inferred.
        compile_seconds: wall time of compiling and warming up in this step.
        ladder: names of the models to choose from.
        gains: estimated gain of each of them for every human, NaN where none was estimated, see
            `ms_highway.choice.rule.Decision`; with one human, NaN for the model in use.
        choice_failed: whether the rule failed to choose, see there.
        status: where the control comes from, see `ms_highway.loop.step.Status`.
        belief: for every human, the probability that each of `ms_highway.planning.ladders.PACKAGE_MODELS` predicts it;
            None where it is not inferred.
        planned: for every human, the name of its model in the plan of this step, which is not ``plan`` if it is late or
            failed.
    """

    control: Control
    plan: Controls
    humans: HumansControls
    models: tuple[str, ...]
    planning_seconds: float = 0.0
    decision_seconds: float = 0.0
    compile_seconds: float = 0.0
    ladder: tuple[str, ...] = ()
    gains: Gains | None = None
    choice_failed: bool = False
    status: Status = "planned"
    belief: Belief | None = None
    planned: tuple[str, ...] = ()

    @property
    def model(self) -> str:
        """Name of the most expensive model in use."""
        return ("", *cheapest_first(self.models))[-1] if self.models[1:] else self.models[0]

    @property
    def thought(self) -> tuple[str, ...]:
        """Names of the models in the plan of this step, whose time is counted."""
        return self.planned or self.models

    def highest_gains(self) -> dict[str, float]:
        """Return the highest estimated gain of each model over all humans, by name."""
        if self.gains is None:
            return {}
        gains = zip(self.ladder, highest_gains(self.gains).tolist(), strict=True)
        return {name: gain for name, gain in gains if np.isfinite(gain)}


class Controller(Protocol):
    """Drive car 0 of a game, one step at a time.

    Attributes:
        game: may be replaced between steps; a game of the same shapes compiles nothing.
    """

    game: Game

    def reset(self) -> None:
        """Forget the past, before a new episode."""

    def step(self, state: State) -> ControlStep:
        """Return the control of the coming step, from the states of all cars now."""


# Functions of the state that drive

YIELD_GAP = 8.0  # m, between bumpers, made for the robot
YIELD_BRAKING = 3.0  # m/s^2, for the robot
MAX_BRAKING = 8.0  # m/s^2
MIN_GAP = 0.5  # m, below which braking grows no further
YIELD_LANES = 1.5  # lanes to the side, within which a human makes room

RETURN = "return a curvature [1/m] and an acceleration [m/s^2]"

DriverFunction: TypeAlias = Callable[[Game, State], Control]
"""Control of a human from its own game, where it is car 0 and the robot car 1, and the state of all cars [cars, 4]."""


class FunctionDriver:
    """Drive a car by a function of the state; plan nothing, and remember nothing.

    Args:
        game: of which car 0 is driven.
        name: in records.
        function: see `ms_highway.add_driver`.
    """

    def __init__(self, game: Game, name: str, function: DriverFunction) -> None:
        self.game, self.name, self.function = game, name, function

    def reset(self) -> None:
        """Nothing is remembered."""

    def step(self, state: State) -> ControlStep:
        """Return the control of the coming step.

        Raises:
            ValueError: if the function does not return two finite numbers.
        """
        start = perf_counter()
        control = np.asarray(self.function(self.game, facing(state)), dtype=float)
        seconds = perf_counter() - start
        if control.shape != (2,) or not np.isfinite(control).all():
            raise ValueError(f"the driver {self.name!r} returned {control.tolist()}; {RETURN}")
        kept = np.tile(control, (self.game.planner.horizon, 1))
        return ControlStep(control, kept, np.zeros((0, *kept.shape)), (self.name,) * self.game.number, seconds)


def unmoved_control(game: Game, state: Float[SameArray, "cars 4"], yields: Any) -> Float[SameArray, "2"]:
    """Return the control, not scaled, of car 0, which yields to car 1, the robot, always or else never.

    It keeps its velocity, and brakes in time for a slower car ahead in its lane. If it never yields, it ignores the
    robot. If it always yields, it brakes for a robot in its lane or the next one as soon as the robot's front has
    passed its own centre, until there is room for the robot, unless another car is between them.
    """
    xp, scene, own, others = state.__array_namespace__(), game.scene, state[0], state[1:]
    length, width = xp.asarray(scene.car_size)[0], xp.asarray(scene.lane_width)
    along, aside = others[:, 0] - own[0], xp.abs(others[:, 1] - own[1])
    gaps, closing = xp.maximum(along - length, MIN_GAP), xp.maximum(own[3] - others[:, 3], 0.0)
    partner = xp.arange(len(others)) == 0
    ahead = (along > 0) & (aside < width / 2) & (yields | ~partner)
    braking = xp.max(xp.where(ahead, closing**2 / (2 * gaps), 0.0))
    between = xp.any(ahead & (along < along[0]) & ~partner)
    beside = (-length / 2 < along[0]) & (along[0] < length + YIELD_GAP) & (aside[0] < YIELD_LANES * width)
    braking = xp.where(yields & beside & ~between, xp.maximum(braking, YIELD_BRAKING), braking)
    kept = keep_velocity(game.world, own)
    hardest = xp.minimum(MAX_BRAKING, own[3] / xp.asarray(game.world.time_step))
    return xp.stack([kept[0], kept[1] - xp.minimum(braking, hardest)])


never_yields: DriverFunction = partial(unmoved_control, yields=False)
always_yields: DriverFunction = partial(unmoved_control, yields=True)

HUMAN_DRIVERS: dict[str, DriverFunction | type[Vehicle]] = {"never": never_yields, "always": always_yields}
"""Human drivers by name. They do not plan: each is a function, or a class of highway-env vehicles."""


def function_names() -> list[str]:
    """Return the names of the drivers that are functions."""
    return [name for name, driver in HUMAN_DRIVERS.items() if not isinstance(driver, type)]


def traceable(name: str, game: Game) -> DriverFunction:
    """Return the function of a human driver, if JAX can trace it as part of a simulation.

    Raises:
        ValueError: if the driver is a class of vehicles, the keyboard, or a function that JAX cannot trace.
    """
    driver, remedy = HUMAN_DRIVERS.get(name), "give add_driver a pure function of jax.numpy, or use `compare`"
    if driver is None or isinstance(driver, type):
        raise ValueError(f"config['human_driver'] is {name!r}, which cannot be simulated; {remedy}")
    try:
        control = jax.eval_shape(driver, swap_roles(game), jnp.zeros((2 + game.number, 4)))
    except Exception as error:  # anything that code of the user's raises
        reason = str(error).partition("\n")[0]
        raise ValueError(f"JAX cannot trace the human driver {name!r}: {reason}; {remedy}") from error
    if jax.tree.map(jnp.shape, control) != (2,):
        raise ValueError(f"the human driver {name!r} returns {control}; {RETURN}")
    return driver
