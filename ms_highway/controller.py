"""What drives a robot live: plan, time it, decide, keep a record.

Controllers work at the public boundary: float64 NumPy states and controls in SI units, car 0 is the one that is
driven, car 1 its partner. They are the only stateful objects of the core.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from statistics import median
from time import perf_counter
from typing import Any, Literal, Protocol, TypeAlias

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.dynamics import keep_velocity, recover_control
from ms_highway.game import Game
from ms_highway.human_models import HumanModel, JointPlan
from ms_highway.reward import reward
from ms_highway.switching import Decision, Memory, Switching, decide, first_memory

__all__ = ["ControlStep", "Controller", "FixedModel", "ModelSwitching", "Status", "compiled_plan", "measure_costs"]

Status: TypeAlias = Literal["planned", "previous plan", "keep velocity"]
"""How a control came about: from this step's plan, or, where that was not finite, from the last good plan or none."""


@dataclass(frozen=True)
class ControlStep:
    """Record of one step of a controller.

    Attributes:
        control: what to execute now, ``(omega, acceleration)``.
        plan: the controls planned over the horizon, [steps, 2].
        human: the partner's controls that the plan counts on, [steps, 2].
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
    """Drives car 0 of a game, one step at a time."""

    def reset(self) -> None:
        """Forget the past, before a new episode."""

    def step(self, state: Float[np.ndarray, "cars 4"]) -> ControlStep:
        """Control for the coming step, given all cars now."""


@partial(jax.jit, static_argnames="model")
def compiled_plan(model: HumanModel, game: Game, state: Float[jax.Array, "cars 4"]) -> JointPlan:
    """``model.plan``, compiled once per model and shape of scene, for all that plan in this process."""
    return model.plan(game, state)


@jax.jit
def _decide(
    switching: Switching,
    game: Game,
    memory: Memory,
    before: Float[jax.Array, "cars 4"],
    control: Float[jax.Array, "2"],
    after: Float[jax.Array, "cars 4"],
) -> Decision:
    """`decide`, with the human's control and the reward observed from the states around the executed step."""
    scale = game.planner.control_scale
    human = recover_control(game.world, before[1], after[1]) / scale
    return decide(switching, game, memory, before, control / scale, human, reward(game.scene, game.robot, after))


_warm: set[Hashable] = set()  # computations that have run before: function, structure and shapes of its arguments


def _warm_up(function: Callable[..., Any], *arguments: Any) -> float:
    """Compile and run once what has not run before; seconds spent, 0 if it was warm already."""
    leaves, structure = jax.tree.flatten(arguments)
    key = (function, structure, tuple(leaf.shape if isinstance(leaf, jax.Array) else leaf for leaf in leaves))
    if key in _warm:
        return 0.0
    start = perf_counter()
    jax.block_until_ready(function(*arguments))
    _warm.add(key)
    return perf_counter() - start


def _warm_up_plans(ladder: Sequence[HumanModel], game: Game, state: Float[jax.Array, "cars 4"]) -> float:
    """Compile the plans under every model; seconds spent."""
    return sum(_warm_up(compiled_plan, model, game, state) for model in ladder)


def _timed(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """Result of a warm computation, and the seconds it took until the result was there."""
    start = perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return result, perf_counter() - start


def measure_costs(
    game: Game, ladder: Sequence[HumanModel], state: Float[np.ndarray, "cars 4"], repeats: int = 20
) -> Float[np.ndarray, "rungs"]:
    """T(M) on this machine: the median seconds of a warm plan in this state, for each model."""
    arguments = game, _checked(state)
    costs = []
    for model in ladder:
        _warm_up(compiled_plan, model, *arguments)
        costs.append(median(_timed(compiled_plan, model, *arguments)[1] for _ in range(repeats)))
    return np.array(costs)


def _checked(state: Float[np.ndarray, "cars 4"]) -> Float[jax.Array, "cars 4"]:
    """The state in the core's precision.

    Raises:
        ValueError: if it is not a finite array [cars, 4] of two cars or more.
    """
    state = np.asarray(state)
    if state.ndim != 2 or state.shape[0] < 2 or state.shape[1] != 4:
        raise ValueError(f"a state has shape [cars, 4] with the robot, its partner and any others; got {state.shape}")
    if not np.isfinite(state).all():
        car, column = np.argwhere(~np.isfinite(state))[0]
        raise ValueError(
            f"the state of car {car} is not finite: {['x', 'y', 'heading', 'speed'][column]} is {state[car, column]}"
        )
    return jnp.asarray(state, dtype=jnp.float32)


def _plan_step(
    model: HumanModel, game: Game, state: Float[jax.Array, "cars 4"], last: ControlStep | None
) -> ControlStep:
    """Plan and time it; where the plan is not finite, go on with the last one, and without one keep velocity."""
    compiling = _warm_up(compiled_plan, model, game, state)
    plan, seconds = _timed(compiled_plan, model, game, state)
    scale = np.asarray(game.planner.control_scale, dtype=float)
    robot, human = np.asarray(plan.robot) * scale, np.asarray(plan.human) * scale
    status: Status = "planned"
    if not (np.isfinite(robot).all() and np.isfinite(human).all()):
        steady = keep_velocity(game.dynamics, np.asarray(state, dtype=float)[:2])
        if last is None or last.status == "keep velocity":
            status = "keep velocity"
            robot, human = (np.tile(control, (len(robot), 1)) for control in steady)
        else:
            status = "previous plan"
            robot, human = np.vstack([last.plan[1:], steady[0]]), np.vstack([last.human[1:], steady[1]])
    return ControlStep(robot[0], robot, human, model.name, seconds, compile_seconds=compiling, status=status)


class FixedModel:
    """Plans every step with the same human model.

    Args:
        game: what is played; car 0 is driven.
        model: the human model that plans; it may be replaced between steps.
        ladder: the models that it may be replaced by, to be compiled before the first step.
    """

    def __init__(self, game: Game, model: HumanModel, ladder: Sequence[HumanModel] = ()) -> None:
        self.game = game
        self.model = model
        self.ladder = ladder
        self.reset()

    def reset(self) -> None:
        """Forget the last plan."""
        self._last: ControlStep | None = None

    def step(self, state: Float[np.ndarray, "cars 4"]) -> ControlStep:
        """Control for the coming step.

        Raises:
            ValueError: if the state is not a finite array [cars, 4] of two cars or more.
        """
        now = _checked(state)
        compiling = _warm_up_plans(self.ladder, self.game, now) if self._last is None else 0.0
        planned = _plan_step(self.model, self.game, now, self._last)
        self._last = replace(planned, compile_seconds=compiling + planned.compile_seconds)
        return self._last


class ModelSwitching:
    """Plans every step with the human model that Algorithm 1 finds worth its time.

    Args:
        game: what is played; car 0 is driven.
        switching: ladder, costs, lambda and the numbers of the algorithm.
    """

    def __init__(self, game: Game, switching: Switching) -> None:
        self.game = game
        self.switching = jax.tree.map(jnp.asarray, switching)
        self.reset()

    def reset(self) -> None:
        """Start again at the bottom of the ladder."""
        self._memory = first_memory(self.switching)
        self._last: ControlStep | None = None
        self._before: Float[jax.Array, "cars 4"] | None = None

    def step(self, state: Float[np.ndarray, "cars 4"]) -> ControlStep:
        """Control for the coming step, after choosing the model from how the last step went.

        Raises:
            ValueError: if the state is not a finite array [cars, 4] of two cars or more.
        """
        now = _checked(state)
        compiling = self._warm_up(now) if self._last is None else 0.0
        seconds, gains = (0.0, {}) if self._last is None else self._choose(self._last.control, now)
        model = self.switching.ladder[int(self._memory.rung)]
        planned = _plan_step(model, self.game, now, self._last)
        self._before = now
        self._last = replace(
            planned, decision_seconds=seconds, compile_seconds=compiling + planned.compile_seconds, gains=gains
        )
        return self._last

    def _warm_up(self, state: Float[jax.Array, "cars 4"]) -> float:
        """Compile every rung and the decision before the first control is due; seconds spent."""
        decision = self.switching, self.game, self._memory, state, jnp.zeros(2), state
        return _warm_up(_decide, *decision) + _warm_up_plans(self.switching.ladder, self.game, state)

    def _choose(
        self, executed: Float[np.ndarray, "2"], now: Float[jax.Array, "cars 4"]
    ) -> tuple[float, dict[str, float]]:
        """Take the decision; seconds spent, and the gains estimated by name of the alternative."""
        rung, ladder = int(self._memory.rung), self.switching.ladder
        control = jnp.asarray(executed, dtype=jnp.float32)
        decision, seconds = _timed(_decide, self.switching, self.game, self._memory, self._before, control, now)
        self._memory = decision.memory
        estimates = {ladder[rung - 1].name: float(decision.gain_down)} if rung > 0 else {}
        if rung < len(ladder) - 1:
            estimates[ladder[-1].name] = float(decision.gain_up)
        return seconds, {name: gain for name, gain in estimates.items() if np.isfinite(gain)}
