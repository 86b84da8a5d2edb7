"""Plan with a human model for each human, by functions that are compiled once, called with few arguments, and timed."""

from collections.abc import Sequence
from functools import cache, partial

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.game.dynamics import facing
from ms_highway.game.features import check_own_features
from ms_highway.game.game import Game, constant_velocity, pair
from ms_highway.planning.human_models import HumanModel, Naive, is_of_package, scaled_prediction, warn_of_limits
from ms_highway.planning.joint import Interaction, joint_ascent
from ms_highway.planning.ladders import human_model
from ms_highway.planning.plans import Plan, cold_start, may_continue, within_limits
from ms_highway.planning.way_out import Escape, keep_way_out
from ms_highway.runtime.arrays import Control, HumansControls, Index, Rungs, State, for_each
from ms_highway.runtime.compilation import Compiled, Placed, jit_quickly, single, timed, warm_up
from ms_highway.runtime.process import refuse_after_fork


def plan_for(
    ladder: tuple[HumanModel, ...], game: Game, state: State, rungs: Rungs | None = None, start: Plan | None = None
) -> Plan:
    """Return a plan whose controls keep to the limits of `ms_highway.game.game.bounded`, where they are finite.

    Args:
        ladder: human models; with one human, the one that predicts it.
        game: with the humans' rewards as the robot believes them.
        state: all cars now.
        rungs: of every human; ignored with one human.
        start: scaled plan to improve; by default, `ms_highway.planning.plans.cold_start`.
    """
    if game.number == 1:
        plan = Plan(*ladder[0].plan(ladder[0].within(game), state, start))
        if is_of_package(ladder[0]):  # keeps to the limits by itself
            return plan
        plan = Plan(jnp.asarray(plan.robot), jnp.asarray(plan.humans))
        held = within_limits(game, state, plan)
        return jax.tree.map(lambda given, limited: jnp.where(jnp.isfinite(given), limited, given), plan, held)
    begin = jax.tree.map(jnp.asarray, cold_start(game, state) if start is None else start)
    return _plan_several(ladder, game, state, rungs, begin)


def _plan_several(ladder: tuple[HumanModel, ...], game: Game, state: State, rungs: Rungs, start: Plan) -> Plan:
    """Plan with a rung for each of several humans.

    For each rung, a loop takes one round for every human on it. So the time of a plan is a sum over the humans, and one
    compiled function plans under all assignments. For the number of steps, see `most_steps`.
    """
    expected: HumansControls = constant_velocity(game, state[1 : 1 + game.number])
    for rung, model in enumerate(ladder):
        if not model.responds and type(model) is not Naive:
            expected = _predict(model, rung, game, state, rungs, start, expected)
    responding = jnp.array([model.responds for model in ladder])[rungs]
    interaction = Interaction(game, state, jnp.argsort(~responding, stable=True), jnp.sum(responding))
    first = Plan(start.robot, jnp.where(responding[:, None, None], start.humans, expected))
    return joint_ascent(interaction, first, most_steps(ladder, game, rungs))


def _predict(
    model: HumanModel, rung: int, game: Game, state: State, rungs: Rungs, start: Plan, expected: HumansControls
) -> HumansControls:
    """Predict the humans on a rung, one after the other, each in the game of the robot with this human alone."""
    anew = game.planner.smooth  # plans up a smooth reward find their own start

    def predict(human: Index, expected: HumansControls) -> HumansControls:
        begin = None if anew else Plan(start.robot, start.humans[human][None])
        return expected.at[human].set(scaled_prediction(model, *pair(model.within(game), state, human), begin))

    return for_each(rungs == rung, predict, expected)


def most_steps(ladder: tuple[HumanModel, ...], game: Game, rungs: Rungs) -> tuple[Index, Index] | None:
    """Return the largest numbers of steps that rungs in use ask for: without responses, and with responses.

    None if all rungs ask for the planner's. Only models that respond count for steps with responses.
    """
    if not any(model.steps for model in ladder):
        return None
    alone, joint = game.planner.steps
    each = [(model.steps or alone, model.responds * (model.steps or joint)) for model in ladder]
    return tuple(jnp.asarray(each)[rungs].max(axis=0))


REPEATS = 20  # of timed plans and decisions


class CompiledPlans:
    """Plan in a game with the models of a ladder, compiled once for all games of the same shapes.

    With one human, each model has a function of its own; among several, one serves all assignments.

    Args:
        game: may differ in numbers from the games that it was compiled for.
        ladder: human models.
    """

    def __init__(self, game: Game, ladder: Sequence[HumanModel]) -> None:
        self.game, self.ladder = game, tuple(ladder)
        self._placed = Placed(single(game))
        self._continues = may_continue(self.ladder, game)

    def plan(self, state: State, rungs: Rungs | Sequence[int], start: Plan | None = None) -> tuple[Plan, float]:
        """Return the scaled plan in a `checked_state`, as NumPy arrays, and the seconds that it took.

        Args:
            state: all cars now.
            rungs: of every human.
            start: scaled plan to improve; by default, `ms_highway.planning.plans.cold_start`.
        """
        function, *arguments = self.call(state, rungs, start)
        planned, seconds = timed(function, *arguments)
        return Plan(*map(np.asarray, planned)), seconds

    def call(self, state: State, rungs: Rungs | Sequence[int], start: Plan | None = None) -> tuple:
        """Return the compiled function of a plan, see `plan_function`, and its arguments."""
        if start is None and self._continues:  # compiled once, with a start
            start = cold_start(self.game, np.asarray(state))
        several = self.game.number > 1
        models = self.ladder if several else (self.ladder[int(rungs[0])],)
        arguments = self._placed.take(), state, np.asarray(rungs, np.int32) if several else None, start
        return plan_function(models).of(*arguments), *arguments

    def warm_up(self, state: State, way_out: bool = False) -> float:
        """Compile and run what has not run before: plans and, if wanted, the way out; return the seconds spent."""
        check_own_features(self.game.scene, self.game.robot, self.game.number, state)
        warn_of_limits(self.ladder, self.game, state)
        several = self.game.number > 1
        assignments = [[rung] * self.game.number for rung in range(1 if several else len(self.ladder))]
        seconds = sum((warm_up(*self.call(state, rungs)) for rungs in assignments), 0.0)
        return seconds + (warm_up(escape, self._placed.take(), state, np.zeros(2, np.float32)) if way_out else 0.0)

    def keep_way_out(self, state: State, control: Control) -> tuple[Escape, float]:
        """Return the result of `ms_highway.planning.way_out.keep_way_out`, and the seconds that it took."""
        found, seconds = timed(escape, self._placed.take(), state, np.asarray(control, np.float32))
        return Escape(*map(np.asarray, found)), seconds


escape = jit_quickly(keep_way_out)


@cache
def plan_function(models: tuple[HumanModel, ...]) -> Compiled:
    """Compile `ms_highway.planning.compiled_plans.plan_for` once for these models, whatever the game's numbers."""
    return jit_quickly(partial(plan_for, models))


def plan(game: Game, state: State, model: HumanModel | str = "tom") -> Plan:
    """Plan in one situation: return the robot's controls [steps, 2], and the controls that it expects of the humans.

    Controls are curvatures [1/m] and accelerations before friction [m/s^2]: with the paper's friction, 4 m/s^2 keep
    20 m/s. Compiled once for all games of the same shapes.

    Args:
        game: what is played, see `ms_highway.game.scenario`.
        state: x, y [m], heading [rad], speed [m/s] of all cars: the robot, the humans, then scripted cars.
        model: human model of all humans, or its name.

    Raises:
        TypeError: if the game is no `Game`.
        ValueError: for an unknown model, a state that is not a finite array [cars, 4] of the game's cars or more, or a
            user-defined feature that is not finite in it.
    """
    if not isinstance(game, Game):
        raise TypeError(f"the game is {game!r}; make a ms_highway.Game with ms_highway.build_game or driving_game")
    refuse_after_fork()
    known = human_model(model) if isinstance(model, str) else model
    now = checked_state(state)
    if len(now) <= game.number:
        raise ValueError(f"the state has {len(now)} cars; the game has a robot and {game.number} humans")
    check_own_features(game.scene, game.robot, game.number, now)
    planned, _ = CompiledPlans(game, [known]).plan(now, [0] * game.number)
    scale = np.asarray(game.planner.control_scale, dtype=float)
    return Plan(planned.robot * scale, planned.humans * scale)


def checked_state(state: State) -> State:
    """Convert a state to single precision without whole turns in headings, by NumPy, which is faster than JAX.

    Raises:
        ValueError: if it is not a finite array [cars, 4] of two cars or more, in that precision.
    """
    state = np.asarray(state)
    if state.ndim != 2 or state.shape[0] < 2 or state.shape[1] != 4:
        raise ValueError(f"a state has shape [cars, 4] with the robot, its partner and any others; got {state.shape}")
    with np.errstate(over="ignore", invalid="ignore"):
        single = facing(state).astype(np.float32)
    if not np.isfinite(single).all():
        car, column = np.argwhere(~np.isfinite(single))[0]
        value, name = state[car, column], ["x", "y", "heading", "speed"][column]
        why = ", too large for single precision" if np.isfinite(value) else ""
        raise ValueError(f"the state of car {car} is not finite: {name} is {value}{why}")
    return single
