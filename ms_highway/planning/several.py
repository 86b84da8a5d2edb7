"""Plan with a human model for each human: one compiled function for all assignments of models to several humans."""

import jax
from jax import numpy as jnp

from ms_highway.game.game import Game, constant_velocity, pair
from ms_highway.planning.human_models import HumanModel, Naive, is_of_package, scaled_prediction
from ms_highway.planning.joint import Interaction, joint_ascent
from ms_highway.planning.plans import Plan, cold_start, within_limits
from ms_highway.runtime.arrays import HumansControls, Index, Rungs, State, for_each


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
