"""Plan live: compiled once, called with few arguments, timed warm."""

from collections.abc import Sequence
from functools import cache
from statistics import median

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.game import Game
from ms_highway.planning.human_models import HumanModel, JointPlan, human_model, plan_within_limits
from ms_highway.runtime.compilation import QUICKLY, in_one_kernel, known_options
from ms_highway.runtime.forks import refuse_after_fork
from ms_highway.runtime.packing import Layout, pack
from ms_highway.runtime.timing import timed, warm_up

__all__ = ["CompiledPlans", "checked_state", "measure_costs", "plan", "plan_function"]

State = Float[jax.Array, "cars 4"]


class CompiledPlans:
    """Plan in a game under each human model, compiled once for all games of the same shapes.

    Args:
        game: may differ in numbers from the games that it was compiled for.
    """

    def __init__(self, game: Game) -> None:
        self._numbers, self._layout = pack(game)
        self._steps = game.planner.horizon

    def plan(
        self, model: HumanModel, state: Float[np.ndarray, "cars 4"], start: JointPlan | None = None
    ) -> tuple[JointPlan, float]:
        """Return the scaled plan in a `checked_state`, in NumPy arrays, and the seconds that it took.

        Args:
            model: human model that plans.
            state: all cars now.
            start: scaled plan to improve; by default, zero controls.
        """
        plan, seconds = timed(self.function(model), *self.arguments(state, start))
        return JointPlan(*np.asarray(plan)), seconds

    def warm_up(self, models: Sequence[HumanModel], state: Float[np.ndarray, "cars 4"]) -> float:
        """Compile and run once those models' plans that have not run before; return the seconds spent."""
        arguments = self.arguments(state)
        return sum((warm_up(self.function(model), *arguments) for model in models), 0.0)

    def function(self, model: HumanModel) -> jax.stages.Wrapped:
        """Return the compiled function of a model's plans, which takes `arguments`; see `plan_function`."""
        return plan_function(model, self._layout)

    def arguments(
        self, state: Float[np.ndarray, "cars 4"], start: JointPlan | None = None
    ) -> tuple[np.ndarray, np.ndarray, jax.Array]:
        """Return the arguments of a `plan_function`."""
        begin = _still(self._steps) if start is None else jnp.asarray(np.asarray(start, dtype=np.float32))
        return self._numbers, state, begin


def plan(game: Game, state: Float[np.ndarray, "cars 4"], model: HumanModel | str = "tom") -> JointPlan:
    """Plan in one situation: the robot's controls, and the human's that it counts on, [steps, 2] each.

    Controls are curvatures [1/m] and accelerations before friction [m/s^2]: with the paper's friction, 4 m/s^2 keep
    20 m/s. Compiled once for all games of the same shapes.

    Args:
        game: what is played, see `ms_highway.game.scenario`.
        state: x, y [m], heading [rad], speed [m/s] of all cars, the robot first, then its partner.
        model: the human model, or its name.

    Raises:
        TypeError: if the game is none.
        ValueError: for an unknown model, or a state that is not a finite array [cars, 4] of two cars or more.
    """
    if not isinstance(game, Game):
        raise TypeError(f"the game is {game!r}; make a ms_highway.Game with ms_highway.build_game or driving_game")
    refuse_after_fork()
    known = human_model(model) if isinstance(model, str) else model
    planned, _ = CompiledPlans(game).plan(known, checked_state(state))
    scale = np.asarray(game.planner.control_scale, dtype=float)
    return JointPlan(*(np.asarray(side) * scale for side in planned))


@cache
def _still(steps: int) -> Float[jax.Array, "2 steps 2"]:
    """Return zero controls for both players."""
    return jnp.zeros((2, steps, 2))


@cache
def plan_function(model: HumanModel, layout: Layout) -> jax.stages.Wrapped:
    """Compile `plan_within_limits` once for all games of a layout.

    The compiled function takes the numbers of a packed game, all cars now, and the plan to start from; plans are arrays
    [2, steps, 2] of the robot's and the human's scaled controls.
    """

    def plan(
        numbers: Float[jax.Array, "n"], state: State, start: Float[jax.Array, "2 steps 2"]
    ) -> Float[jax.Array, "2 steps 2"]:
        return jnp.stack(plan_within_limits(model, layout.unpack(numbers), state, JointPlan(*start)))

    if model.responds:  # by LAPACK (`eigh` or `solve`), whose calls cannot be part of a kernel
        return jax.jit(plan, compiler_options=known_options(QUICKLY))
    return jax.jit(in_one_kernel(plan))


def checked_state(state: Float[np.ndarray, "cars 4"]) -> Float[np.ndarray, "cars 4"]:
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
    game: Game, ladder: Sequence[HumanModel], state: Float[np.ndarray, "cars 4"], repeats: int = 20
) -> Float[np.ndarray, "rungs"]:
    """Measure T(M) on this machine: the median seconds of a warm plan in this state, for each model.

    Raises:
        ValueError: if the state is not a finite array [cars, 4] of two cars or more.
    """
    refuse_after_fork()
    plans, now = CompiledPlans(game), checked_state(state)
    plans.warm_up(ladder, now)
    return np.array([median(plans.plan(model, now)[1] for _ in range(repeats)) for model in ladder])
