"""Choose models and start plans in a game: what live drivers and batches share.

Everything here works for numbers of NumPy and of JAX.
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

    Args:
        game: as the robot believes it.
        models: which rungs name.
        unresponsive: rung that predicts humans who do not respond; None to count on
            everybody, without inferring who responds.
        decide: chooses rungs by the outcome, see `ms_highway.choice.rule.decide`.
        carry: into the step.
        now: all cars.
    """
    # Observe the humans' controls, and what the step has earned.
    before = carry.outcome.before
    humans = slice(1, 1 + game.number)
    controls = recover_control(game.world, before[humans], now[humans])
    outcome = carry.outcome._replace(
        after=now,
        humans=controls / game.planner.control_scale,
        reward=reward(game.scene, game.robot, now),
    )

    # Without knowing who responds, count on what the rule chose.
    if unresponsive is None:
        decision = decide(carry.memory, outcome)
        rungs = decision.memory.rungs
        return Choice(carry.model_probabilities, decision, rungs, observation=None)

    # Infer which model each human follows. Before the first step, nobody has moved.
    assert carry.model_probabilities is not None
    moved = jnp.any(before != now)
    inferred = infer_models(
        game, carry.model_probabilities, before, now, outcome.plan.robot
    )
    probabilities = jnp.where(moved, inferred, carry.model_probabilities)

    # Where a model counts on a human who does not respond, take another one.
    decision = decide(carry.memory, outcome)
    counts_on_response = jnp.array([model.responds for model in models])
    in_vain = counts_on_response[decision.memory.rungs] & ~likely_to_respond(
        probabilities
    )
    rungs = jnp.where(in_vain, unresponsive, decision.memory.rungs).astype(jnp.int32)
    return Choice(probabilities, decision, rungs, observation=None)


def plan_start(
    models: tuple[HumanModel, ...],
    game: Game,
    state: State,
    rungs: Rungs,
    last: RemainingPlan[Plan],
) -> Plan | None:
    """Return the scaled plan from which the coming one starts.

    Humans continue the last plan if the planner or their model wants that; the robot
    does if any human does. All others start cold. It is None if no model ever
    continues.

    Args:
        models: that rungs name.
        game: of the robot.
        state: all cars now.
        rungs: of every human in the coming plan.
        last: the plan to fall back on.
    """
    warm = np.array([game.planner.solver.continues or model.warm for model in models])
    if not warm.any():
        return None
    cold = cold_start(game, state)
    rest = last.warm_start.later()

    xp = rungs.__array_namespace__()  # of NumPy or JAX
    continues = xp.asarray(warm)[rungs] & (last.steps > 0)  # [humans]
    robot = xp.where(continues.any(), rest.robot, cold.robot)
    humans = xp.where(continues[:, None, None], rest.humans, cold.humans)
    return Plan(robot, humans)
