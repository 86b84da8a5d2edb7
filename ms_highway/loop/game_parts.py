"""Choose models and start plans in a game: what live drivers and batches share.

Everything here works for arrays of NumPy and of JAX.
"""

from collections.abc import Callable

import numpy as np
from jax import numpy as jnp

from ms_highway.choice.belief import infer_models, likely_to_respond
from ms_highway.choice.rule import Decision, Memory, Outcome
from ms_highway.game.dynamics import recover_control
from ms_highway.game.features import reward
from ms_highway.game.game import Game
from ms_highway.loop.step import Choice, GameCarry, GameChoice, RemainingPlan
from ms_highway.planning.human_models import HumanModel
from ms_highway.planning.plans import Plan, cold_start
from ms_highway.runtime.arrays import RungIndex, Rungs, State


def choose(
    game: Game,
    models: tuple[HumanModel, ...],
    unresponsive: RungIndex | None,
    decide: Callable[[Memory, Outcome[State]], Decision],
    carry: GameCarry,
    now: State,
) -> GameChoice:
    """Observe what the last step has shown, and choose a model of each human.

    Humans who do not respond get another rung than the rule chose. The rule learns of
    it in the next step, from its memory.

    Args:
        game: as the robot believes it.
        models: models that rungs name.
        unresponsive: rung that predicts humans who do not respond; None to rely on
            everybody, without inferring who responds.
        decide: chooses rungs by the outcome, see `ms_highway.choice.rule.decide`.
        carry: what the robot carries into the step; its outcome is completed here.
        now: all cars.
    """
    # Complete the outcome of the last step: the humans' controls, and the reward.
    before = carry.outcome.before
    humans = slice(1, 1 + game.number)
    controls = recover_control(game.world, before[humans], now[humans])
    outcome = carry.outcome._replace(
        after=now,
        humans=controls / game.planner.control_scale,
        reward=reward(game.scene, game.robot, now),
    )

    # Without a belief, take what the rule chooses.
    if unresponsive is None:
        decision = decide(carry.memory, outcome)
        rungs = decision.memory.rungs
        return Choice(carry.model_probabilities, decision, rungs, observation=None)

    # Infer which model each human follows. Where no car has moved, as before the first
    # step, nothing can be inferred.
    last_probabilities = carry.model_probabilities
    assert last_probabilities is not None
    moved = jnp.any(before != now)
    inferred = infer_models(game, last_probabilities, before, now, outcome.plan.robot)
    probabilities = jnp.where(moved, inferred, last_probabilities)

    # Replace the models that rely on the response of a human who hardly responds.
    decision = decide(carry.memory, outcome)
    chosen = decision.memory.rungs
    relies_on_response = jnp.array([model.responds for model in models])[chosen]
    is_misplaced = relies_on_response & ~likely_to_respond(probabilities)
    rungs = jnp.where(is_misplaced, unresponsive, chosen).astype(jnp.int32)
    return Choice(probabilities, decision, rungs, observation=None)


def plan_start(
    models: tuple[HumanModel, ...],
    game: Game,
    state: State,
    rungs: Rungs,
    last: RemainingPlan[Plan],
) -> Plan | None:
    """Return the scaled initial guess of the coming plan; None if all start cold.

    A human starts warm, from the rest of the last plan, if the planner or the human's
    model wants that and any control of the last plan is left. The robot starts warm if
    any human does. All others start cold.

    Args:
        models: models that rungs name.
        game: game of the robot.
        state: all cars now.
        rungs: rung of each human's model in the coming plan.
        last: plan whose warm start is continued.
    """
    solver = game.planner.solver
    warm = np.array([solver.continues or model.warm for model in models])
    if not warm.any():
        return None
    cold = cold_start(game, state)
    rest = last.warm_start.later()

    xp = rungs.__array_namespace__()  # of NumPy or JAX
    wants_warm = xp.asarray(warm)[rungs]
    continues = wants_warm & (last.controls_left > 0)  # [humans]
    robot = xp.where(continues.any(), rest.robot, cold.robot)
    humans = xp.where(continues[:, None, None], rest.humans, cold.humans)
    return Plan(robot, humans)
