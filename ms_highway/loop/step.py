"""One step of a robot among humans, live or in a batch: look at the last step, choose models, plan, follow the plan.

Pure functions over what the robot carries from step to step. `ms_highway.planning.several.plan_for` makes the plan,
`ms_highway.loop.fallback.follow` chooses what is followed.
"""

from typing import NamedTuple

import numpy as np
from jax import numpy as jnp

from ms_highway.choice.belief import counted_on, first_belief, infer
from ms_highway.choice.rule import Decision, Memory, Outcome, Rule, first_memory
from ms_highway.game.dynamics import recover_control
from ms_highway.game.features import reward
from ms_highway.game.game import Game
from ms_highway.loop.fallback import Followed, Rest
from ms_highway.planning.human_models import HumanModel
from ms_highway.planning.plans import Plan
from ms_highway.runtime.arrays import Belief, Rungs, State


class Carry(NamedTuple):
    """What a robot carries from step to step.

    Attributes:
        memory: of its rule.
        outcome: of the last step; before the first one, of a step in which no car moved.
        belief: probability that each of the package's models predicts each human.
    """

    memory: Memory
    outcome: Outcome
    belief: Belief


def begin(rule: Rule, game: Game, state: State) -> Carry:
    """Return what a robot carries into its first step."""
    still = np.zeros((1 + game.number, game.planner.horizon, 2), np.float32)
    outcome = Outcome(state, state, still[0, 0], still[1:, 0], np.float32(0), Plan(still[0], still[1:]))
    return Carry(first_memory(rule, game.number), outcome, first_belief(game.number))


def complete_outcome(game: Game, carry: Carry, now: State, infers: bool) -> Carry:
    """Complete the outcome of the last step: observed controls, the reward and, if wanted, the belief."""
    outcome, last = carry.outcome, 1 + game.number
    controls = recover_control(game.world, outcome.before[1:last], now[1:last]) / game.planner.control_scale
    outcome = outcome._replace(after=now, humans=controls, reward=reward(game.scene, game.robot, now))
    belief = carry.belief
    if infers:
        moved = jnp.any(outcome.before != now)  # before the first step, nothing is seen of the humans
        belief = jnp.where(moved, infer(game, belief, outcome.before, now, outcome.plan.robot), belief)
    return carry._replace(outcome=outcome, belief=belief)


def responsive_rungs(ladder: tuple[HumanModel, ...], rungs: Rungs, belief: Belief, unresponsive: int | None) -> Rungs:
    """Predict unresponsive humans by the rung ``unresponsive`` instead of one that counts on a response.

    Args:
        ladder: human models.
        rungs: that were chosen.
        belief: see `Carry`.
        unresponsive: rung, or None to count on everybody's response.
    """
    if unresponsive is None:
        return rungs
    responds = jnp.array([model.responds for model in ladder])
    return jnp.where(responds[rungs] & ~counted_on(belief), unresponsive, rungs).astype(jnp.int32)


def decide(
    rule: Rule, game: Game, carry: Carry, now: State, unresponsive: int | None = None
) -> tuple[Belief, Decision]:
    """Choose the rungs of the coming step from the outcome of the last one, and return the belief with them.

    Args:
        rule: that chooses.
        game: as the robot believes it.
        carry: into the step.
        now: all cars.
        unresponsive: see `responsive_rungs`; None without a belief.
    """
    carry = complete_outcome(game, carry, now, unresponsive is not None)
    decision = rule.decide(game, carry.memory, carry.outcome)
    rungs = responsive_rungs(rule.ladder, decision.memory.rungs, carry.belief, unresponsive)
    return carry.belief, decision._replace(memory=decision.memory._replace(rungs=rungs))


def continues_plan(ladder: tuple[HumanModel, ...], game: Game, rungs: Rungs, rest: Rest) -> bool:
    """Return whether the coming plan starts from the rest of the last one, as the planner or a rung wants."""
    warm = np.array([model.warm for model in ladder])
    wanted = game.planner.persistent or bool(warm.all())
    if not wanted and warm.any():
        wanted = rungs.__array_namespace__().asarray(warm)[rungs].any()
    return wanted & (rest.steps > 0)


def advance(carry: Carry, decision: Decision, followed: Followed, state: State) -> Carry:
    """Return what is carried into the next step; there, `complete_outcome` completes the outcome of this one.

    Args:
        carry: into this step.
        decision: of this step.
        followed: what drives in this step.
        state: all cars before this step.
    """
    driven = followed.now
    memory = decision.memory._replace(rungs=driven.rungs, step=carry.memory.step + 1)
    outcome = carry.outcome._replace(before=state, after=state, robot=driven.plan.robot[0], plan=driven.plan)
    return carry._replace(memory=memory, outcome=outcome)
