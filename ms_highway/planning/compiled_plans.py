"""Plan live: compiled once, called with few arguments, timed warm."""

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.game import Game
from ms_highway.planning.human_models import HumanModel, human_model
from ms_highway.planning.plans import Plan, cold_start
from ms_highway.planning.several import plan_for
from ms_highway.planning.way_out import Escape, keep_way_out
from ms_highway.runtime.arrays import Array, Control, Rungs, Scalar, State
from ms_highway.runtime.compilation import Layout, in_one_kernel, pack, quick_options
from ms_highway.runtime.forks import refuse_after_fork
from ms_highway.runtime.timing import timed, warm_up


class Costs(NamedTuple):
    """Planning time, additive in the humans: ``T = base + sum_i each[rung_i]`` [s].

    Attributes:
        base: of a plan in which every human is predicted by the first rung; 0 with one human.
        each: what a human adds under each rung; with one human, T(M) of the whole plan.
    """

    base: Scalar
    each: Float[Array, "rungs"]

    @classmethod
    def of(cls, seconds: Sequence[float], humans: int) -> "Costs":
        """Return the costs that follow from plans in which one human is on each rung, and the others on the first."""
        base = float(seconds[0]) if humans > 1 else 0.0
        return cls(base, np.asarray(seconds) - base)


class CompiledPlans:
    """Plan in a game with the models of a ladder, compiled once for all games of the same shapes.

    With one human, each model has a function of its own; among several, one serves all assignments.

    Args:
        game: may differ in numbers from the games that it was compiled for.
        ladder: human models.
    """

    def __init__(self, game: Game, ladder: Sequence[HumanModel]) -> None:
        self.game, self.ladder = game, tuple(ladder)
        self._numbers, self._layout = pack(game)

    def plan(self, state: State, rungs: Rungs | Sequence[int], start: Plan | None = None) -> tuple[Plan, float]:
        """Return the scaled plan in a `checked_state`, in NumPy arrays, and the seconds that it took.

        Args:
            state: all cars now.
            rungs: of every human.
            start: scaled plan to improve; by default, `ms_highway.planning.plans.cold_start`.
        """
        function, *arguments = self.call(state, rungs, start)
        plan, seconds = timed(function, *arguments)
        plan = np.asarray(plan)
        return Plan(plan[0], plan[1:]), seconds

    def call(self, state: State, rungs: Rungs | Sequence[int], start: Plan | None = None) -> tuple:
        """Return the compiled function of a plan, see `plan_function`, and its arguments."""
        begin: Any
        if start is not None:
            begin = np.concatenate([start.robot[None], start.humans], dtype=np.float32)
        elif self.game.planner.for_seconds:
            robot, humans = cold_start(self.game, np.asarray(state))
            begin = np.concatenate([robot[None], humans], dtype=np.float32)
        else:
            begin = _still(1 + self.game.number, self.game.planner.horizon)
        if self.game.number > 1:
            return plan_function(self.ladder, self._layout), self._numbers, state, begin, np.asarray(rungs, np.int32)
        model = self.ladder[int(rungs[0])]
        fuses = not model.responds and not self.game.planner.for_seconds
        return plan_function((model,), self._layout, fuses), self._numbers, state, begin

    def warm_up(self, state: State) -> float:
        """Compile and run the plans that have not run before; return the seconds spent."""
        several = self.game.number > 1
        assignments = [[rung] * self.game.number for rung in range(1 if several else len(self.ladder))]
        return sum((warm_up(*self.call(state, rungs)) for rungs in assignments), 0.0)

    def keep_way_out(self, state: State, control: Control) -> tuple[Escape, float]:
        """Return what `ms_highway.planning.way_out.keep_way_out` does, and the seconds that it took."""
        escape, seconds = timed(way_out_function(self._layout), self._numbers, state, np.asarray(control, np.float32))
        return Escape(*map(np.asarray, escape)), seconds

    def warm_up_way_out(self, state: State) -> float:
        """Compile and run what looks for a way out if it has not run before; return the seconds spent."""
        return warm_up(way_out_function(self._layout), self._numbers, state, np.zeros(2, np.float32))


def plan(game: Game, state: State, model: HumanModel | str = "tom") -> Plan:
    """Plan in one situation: the robot's controls [steps, 2], and those of the humans that it counts on.

    Controls are curvatures [1/m] and accelerations before friction [m/s^2]: with the paper's friction, 4 m/s^2 keep
    20 m/s. Compiled once for all games of the same shapes.

    Args:
        game: what is played, see `ms_highway.game.scenario`.
        state: x, y [m], heading [rad], speed [m/s] of all cars: the robot, the humans, then scripted cars.
        model: the human model of all humans, or its name.

    Raises:
        TypeError: if the game is none.
        ValueError: for an unknown model, or a state that is not a finite array [cars, 4] of the game's cars or more.
    """
    if not isinstance(game, Game):
        raise TypeError(f"the game is {game!r}; make a ms_highway.Game with ms_highway.build_game or driving_game")
    refuse_after_fork()
    known = human_model(model) if isinstance(model, str) else model
    now = checked_state(state)
    if len(now) <= game.number:
        raise ValueError(f"the state has {len(now)} cars; the game has a robot and {game.number} humans")
    planned, _ = CompiledPlans(game, [known]).plan(now, [0] * game.number)
    scale = np.asarray(game.planner.control_scale, dtype=float)
    return Plan(planned.robot * scale, planned.humans * scale)


@cache
def _still(cars: int, steps: int) -> Array:
    """Return zero controls of some cars."""
    return jnp.zeros((cars, steps, 2), jnp.float32)


@cache
def plan_function(ladder: tuple[HumanModel, ...], layout: Layout, fuses: bool = False) -> jax.stages.Wrapped:
    """Compile `ms_highway.planning.several.plan_for` once for all games of a layout.

    The compiled function takes the numbers of a packed game, all cars now, the plan to start from, an array [cars,
    steps, 2] of the scaled controls of robot and humans, and, with several humans, their rungs. It returns such a plan.

    Args:
        ladder: human models; with one human, the one that predicts it.
        layout: of the game.
        fuses: whether to compile one kernel, of which calls of LAPACK (``eigh``, ``solve``) cannot be part.
    """

    def plan(numbers: Array, state: State, start: Array, rungs: Rungs | None = None) -> Array:
        robot, humans = plan_for(ladder, layout.unpack(numbers), state, rungs, Plan(start[0], start[1:]))
        return jnp.concatenate([robot[None], humans])

    return jax.jit(in_one_kernel(plan)) if fuses else jax.jit(plan, compiler_options=quick_options())


@cache
def way_out_function(layout: Layout) -> jax.stages.Wrapped:
    """Compile `keep_way_out` once for all games of a layout; it takes a packed game, all cars, and a scaled control."""
    return jax.jit(
        lambda numbers, state, control: keep_way_out(layout.unpack(numbers), state, control),
        compiler_options=quick_options(),
    )


def checked_state(state: State) -> State:
    """Copy a state in single precision, which is faster than a conversion by JAX.

    Raises:
        ValueError: if it is not a finite array [cars, 4] of two cars or more, in that precision.
    """
    state = np.asarray(state)
    if state.ndim != 2 or state.shape[0] < 2 or state.shape[1] != 4:
        raise ValueError(f"a state has shape [cars, 4] with the robot, its partner and any others; got {state.shape}")
    with np.errstate(over="ignore"):
        single = state.astype(np.float32)
    if not np.isfinite(single).all():
        car, column = np.argwhere(~np.isfinite(single))[0]
        value, name = state[car, column], ["x", "y", "heading", "speed"][column]
        why = ", too large for single precision" if np.isfinite(value) else ""
        raise ValueError(f"the state of car {car} is not finite: {name} is {value}{why}")
    return single


def measure_costs(
    game: Game,
    ladder: Sequence[HumanModel],
    state: State,
    repeats: int = 20,
    quantile: float = 0.5,
    way_out: bool = False,
) -> Costs:
    """Measure T on this machine, by warm plans in this state with all humans on the same rung.

    Args:
        game: that is played.
        ladder: human models.
        state: all cars.
        repeats: number of plans that are timed on each rung.
        quantile: of their seconds: the median by default; close to 1 for budgets.
        way_out: whether the check of the way out counts, too.

    Raises:
        ValueError: if the state is not a finite array [cars, 4] of two cars or more.
    """
    refuse_after_fork()
    plans, now = CompiledPlans(game, ladder), checked_state(state)
    plans.warm_up(now)
    if way_out:
        plans.warm_up_way_out(now)

    def once(rung: int) -> float:
        plan, seconds = plans.plan(now, [rung] * game.number)
        return seconds + (plans.keep_way_out(now, plan.robot[0])[1] if way_out else 0.0)

    whole = np.quantile([[once(rung) for _ in range(repeats)] for rung in range(len(ladder))], quantile, axis=1)
    base = float(whole[0]) if game.number > 1 else 0.0
    return Costs(base, np.maximum(whole - base, 0.0) / game.number)
