"""What drives a robot live: plan, time it, decide, keep a record.

Controllers work at the public boundary: float64 NumPy states and controls in SI units, car 0 is the one that is
driven, car 1 its partner. They are the only stateful objects of the core.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Literal, Protocol, TypeAlias

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.compiled import (
    checked_state,
    decide_function,
    observation,
    pack,
    packed_memory,
    plan_function,
    refuse_after_fork,
    timed,
    warm_up,
)
from ms_highway.dynamics import SameArray, keep_velocity, step
from ms_highway.game import Game
from ms_highway.human_models import HumanModel
from ms_highway.switching import Switching, check_costs, first_memory

__all__ = [
    "ControlStep",
    "Controller",
    "FixedModel",
    "ModelSwitching",
    "ScheduledModels",
    "Status",
    "braking_control",
]

Status: TypeAlias = Literal["planned", "previous plan", "braking"]
"""How a control came about: from this step's plan; or, where that was not finite, from what is left of the last good
plan, and when nothing is left from braking in lane."""

BRAKING = 8.0  # m/s^2, hard braking on a dry road
STRAIGHTENING_TIME = 0.5  # s, in which a braking car turns back along the road


@dataclass(frozen=True)
class ControlStep:
    """Record of one step of a controller.

    Attributes:
        control: what to execute now, ``(omega, acceleration)``.
        plan: the controls planned over the horizon, [steps, 2]; fewer where only part of the last plan is left.
        human: the partner's controls that the plan counts on, as many.
        model: name of the human model that planned.
        planning_seconds: wall time of the plan, compilation excluded.
        decision_seconds: wall time of choosing the model, compilation excluded; 0 without a choice.
        compile_seconds: time spent compiling and warming up in this step.
        gains: estimated gain of switching to each model that was considered, by name.
        status: how the control came about.
    """

    control: Float[np.ndarray, "2"]
    plan: Float[np.ndarray, "steps 2"]
    human: Float[np.ndarray, "steps 2"]
    model: str
    planning_seconds: float
    decision_seconds: float = 0.0
    compile_seconds: float = 0.0
    gains: Mapping[str, float] = field(default_factory=dict)
    status: Status = "planned"


class Controller(Protocol):
    """Drives car 0 of a game, one step at a time.

    Attributes:
        game: what is played; it may change between steps, and one of the same shapes compiles nothing.
    """

    game: Game

    def reset(self) -> None:
        """Forget the past, before a new episode."""

    def meet(self) -> None:
        """Forget the partner: from now on, car 1 is another."""

    def step(
        self, state: Float[np.ndarray, "cars 4"], before: Float[np.ndarray, "cars 4"] | None = None
    ) -> ControlStep:
        """Control for the coming step, given all cars now.

        Args:
            state: all cars now.
            before: all cars before the last step, in the coordinates of now, where these have changed since.
        """


def braking_control(game: Game, car: Float[SameArray, "4"]) -> Float[SameArray, "2"]:
    """The control with which a car goes on, or begins, to brake and to turn along the road, within a plan's limits.

    It is finite in every finite state, even where friction, or the acceleration that would stop the car, is not.
    """
    xp = car.__array_namespace__()
    heading, speed = car[2], car[3]
    turning = -xp.atan2(xp.sin(heading), xp.cos(heading)) / STRAIGHTENING_TIME
    omega = turning / xp.maximum(xp.abs(speed), 1.0) if game.dynamics.steering == "curvature" else turning
    stop = keep_velocity(game.dynamics, car)[1] - speed / game.dynamics.time_step
    stop = xp.where(xp.isnan(stop), -xp.sign(speed) * BRAKING, stop)
    limit = xp.asarray(game.planner.control_limit)
    return xp.clip(xp.stack([omega, xp.clip(stop, -BRAKING, BRAKING)]), -limit, limit)


def brake(game: Game, car: Float[np.ndarray, "4"]) -> Float[np.ndarray, "steps 2"]:
    """Controls that bring a car to a stop and along the road, within the limits of the game's plans."""
    car, controls = np.asarray(car, dtype=float), []
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(game.planner.horizon):
            controls.append(braking_control(game, car))
            moved = step(game.dynamics, car, controls[-1])
            car = np.where(np.isfinite(moved), moved, car)
    return np.array(controls)


def _record(
    game: Game,
    model: HumanModel,
    plan: Float[jax.Array, "2 steps 2"],
    state: Float[np.ndarray, "cars 4"],
    last: ControlStep | None,
) -> ControlStep:
    """The record of a plan; where the plan is not finite, of what is left of the last one, or of braking."""
    robot, human = np.asarray(plan) * np.asarray(game.planner.control_scale, dtype=float)
    status: Status = "planned"
    if not (np.isfinite(robot).all() and np.isfinite(human).all()):
        if last is not None and last.status != "braking" and len(last.plan) > 1:
            status, robot, human = "previous plan", last.plan[1:], last.human[1:]
        else:
            status, robot = "braking", brake(game, state[0])
            human = np.tile(keep_velocity(game.dynamics, np.asarray(state, dtype=float)[1]), (len(robot), 1))
    return ControlStep(robot[0], robot, human, model.name, 0.0, status=status)


@cache
def _still(steps: int) -> Float[jax.Array, "2 steps 2"]:
    """Zero controls for both players."""
    return jnp.zeros((2, steps, 2))


def _start(game: Game, last: ControlStep | None) -> Float[jax.Array, "2 steps 2"]:
    """Where a warm start begins: the rest of the last plan, scaled, its last control repeated; cold without one."""
    if last is None:
        return _still(game.planner.horizon)
    rest = np.minimum(np.arange(1, game.planner.horizon + 1), len(last.plan) - 1)
    scale = np.asarray(game.planner.control_scale)
    return jnp.asarray((np.stack([last.plan[rest], last.human[rest]]) / scale).astype(np.float32))


def _stranger(last: ControlStep | None) -> ControlStep | None:
    """The last step of a controller that meets another partner: what it expected of the last one says nothing."""
    return last and replace(last, human=np.zeros_like(last.human))


class FixedModel:
    """Plans every step with the same human model.

    Args:
        game: what is played; car 0 is driven.
        model: the human model that plans; it may be replaced between steps.
        ladder: the models that it may be replaced by, to be compiled before the first step.
        warm_start: whether plans start from the last one rather than from zero controls.
    """

    def __init__(
        self, game: Game, model: HumanModel, ladder: Sequence[HumanModel] = (), warm_start: bool = False
    ) -> None:
        self.model = model
        self.ladder = ladder
        self.warm_start = warm_start
        self.game = game
        self.reset()

    @property
    def game(self) -> Game:
        """What is played; it may change between steps, and one of the same shapes compiles nothing."""
        return self._game

    @game.setter
    def game(self, game: Game) -> None:
        self._game = game
        self._numbers, self._layout = pack(game)

    def reset(self) -> None:
        """Forget the last plan."""
        self._last: ControlStep | None = None

    def meet(self) -> None:
        """Forget what the last plan expected of the partner."""
        self._last = _stranger(self._last)

    def step(
        self, state: Float[np.ndarray, "cars 4"], before: Float[np.ndarray, "cars 4"] | None = None
    ) -> ControlStep:
        """Control for the coming step, whatever was before.

        Raises:
            ValueError: if the state is not a finite array [cars, 4] of two cars or more.
        """
        refuse_after_fork()
        now = checked_state(state)
        arguments = self._numbers, now, _start(self.game, self._last if self.warm_start else None)
        models = [self.model] if self._last else [*self.ladder, self.model]
        compiling = sum((warm_up(plan_function(model, self._layout), *arguments) for model in models), 0.0)
        plan, seconds = timed(plan_function(self.model, self._layout), *arguments)
        planned = _record(self.game, self.model, plan, state, self._last)
        self._last = replace(planned, planning_seconds=seconds, compile_seconds=compiling)
        return self._last


class ScheduledModels:
    """Plans with human models in an order that was fixed beforehand, whatever happens.

    Args:
        game: what is played; car 0 is driven.
        models: one per step of the episode; the last one goes on.
        warm_start: whether plans start from the last one rather than from zero controls.

    Raises:
        ValueError: without a model.
    """

    def __init__(self, game: Game, models: Sequence[HumanModel], warm_start: bool = False) -> None:
        if not models:
            raise ValueError("a schedule needs one human model at least")
        self.models = tuple(models)
        self._driver = FixedModel(game, self.models[0], tuple(dict.fromkeys(self.models)), warm_start)
        self.reset()

    @property
    def game(self) -> Game:
        """What is played; it may change between steps, and one of the same shapes compiles nothing."""
        return self._driver.game

    @game.setter
    def game(self, game: Game) -> None:
        self._driver.game = game

    def reset(self) -> None:
        """Start the schedule again."""
        self._driver.reset()
        self._steps = 0

    def meet(self) -> None:
        """Forget what the last plan expected of the partner; the schedule goes on."""
        self._driver.meet()

    def step(
        self, state: Float[np.ndarray, "cars 4"], before: Float[np.ndarray, "cars 4"] | None = None
    ) -> ControlStep:
        """Control for the coming step, by the model whose turn it is.

        Raises:
            ValueError: if the state is not a finite array [cars, 4] of two cars or more.
        """
        self._driver.model = self.models[min(self._steps, len(self.models) - 1)]
        planned = self._driver.step(state)
        self._steps += 1
        return planned


class ModelSwitching:
    """Plans every step with the human model that Algorithm 1 finds worth its time.

    Args:
        game: what is played; car 0 is driven.
        switching: ladder, costs, lambda and the numbers of the algorithm.
        warm_start: whether plans start from the last one rather than from zero controls.

    Raises:
        ValueError: if there is not one cost for each rung of the ladder.
    """

    def __init__(self, game: Game, switching: Switching, warm_start: bool = False) -> None:
        check_costs(switching)
        self.switching = switching
        self.warm_start = warm_start
        self.game = game
        self.reset()

    @property
    def game(self) -> Game:
        """What is played; it may change between steps, and one of the same shapes compiles nothing."""
        return self._game

    @game.setter
    def game(self, game: Game) -> None:
        self._game = game
        self._numbers, self._layout = pack(game)
        self._switching_numbers, self._switching_layout = pack((self.switching, game))
        self._warm = False

    def reset(self) -> None:
        """Start again at the bottom of the ladder."""
        self._memory = packed_memory(first_memory(self.switching))
        self._last: ControlStep | None = None
        self._before: Float[np.ndarray, "cars 4"] | None = None

    def meet(self) -> None:
        """Start again at the bottom of the ladder; how the last step went tells nothing of another partner."""
        self._memory = packed_memory(first_memory(self.switching))
        self._last, self._before = _stranger(self._last), None

    def step(
        self, state: Float[np.ndarray, "cars 4"], before: Float[np.ndarray, "cars 4"] | None = None
    ) -> ControlStep:
        """Control for the coming step, after choosing the model from how the last step went.

        Args:
            state: all cars now.
            before: all cars before the last step, in the coordinates of now, where these have changed since.

        Raises:
            ValueError: if a state is not a finite array [cars, 4] of two cars or more.
        """
        refuse_after_fork()
        now = checked_state(state)
        compiling, deciding, gains = self._warm_up(now), 0.0, dict[str, float]()
        if self._last is not None and self._before is not None:
            before = self._before if before is None else checked_state(before)
            deciding, gains = self._choose(before, self._last.control, now)
        model = self.switching.ladder[int(self._memory[0])]
        start = _start(self.game, self._last if self.warm_start else None)
        plan, planning = timed(plan_function(model, self._layout), self._numbers, now, start)
        record = _record(self.game, model, plan, state, self._last)
        self._before = now
        self._last = replace(
            record, planning_seconds=planning, decision_seconds=deciding, compile_seconds=compiling, gains=gains
        )
        return self._last

    def _warm_up(self, state: Float[np.ndarray, "cars 4"]) -> float:
        """Compile every rung and the decision before the first control of a game is due; seconds spent."""
        if self._warm:
            return 0.0
        self._warm = True
        rungs = [plan_function(model, self._layout) for model in self.switching.ladder]
        plans = sum(warm_up(rung, self._numbers, state, _start(self.game, None)) for rung in rungs)
        observed = observation(self._memory, state, np.zeros(2), state)
        return plans + warm_up(decide_function(self._switching_layout), observed, self._switching_numbers)

    def _choose(
        self, before: Float[np.ndarray, "cars 4"], executed: Float[np.ndarray, "2"], now: Float[np.ndarray, "cars 4"]
    ) -> tuple[float, dict[str, float]]:
        """Take the decision; seconds spent, and the gains estimated by name of the alternative."""
        rung, ladder = int(self._memory[0]), self.switching.ladder
        observed = observation(self._memory, before, executed, now)
        decision, seconds = timed(decide_function(self._switching_layout), observed, self._switching_numbers)
        *memory, up, down = np.asarray(decision)
        self._memory = np.array(memory)
        estimates = {ladder[rung - 1].name: float(down)} if rung > 0 else {}
        if rung < len(ladder) - 1:
            estimates[ladder[-1].name] = float(up)
        return seconds, {name: gain for name, gain in estimates.items() if np.isfinite(gain)}
