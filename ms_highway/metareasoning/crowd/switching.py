"""Decide by Algorithm 1 for each human alone: the paper's way to extend it to several humans."""

from dataclasses import dataclass

import jax
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int

from ms_highway.game.crowd import Crowd, pair
from ms_highway.game.game import Game
from ms_highway.metareasoning.crowd.rule import CrowdDecision, CrowdMemory, CrowdOutcome
from ms_highway.metareasoning.quadratic_rule import TRUST_TOLERANCE, change_of_control
from ms_highway.metareasoning.rule import Decision, Memory, Outcome, decide_by
from ms_highway.metareasoning.switching import Switching
from ms_highway.planning.compiled_crowd import CrowdCosts
from ms_highway.planning.crowd import NAIVE, RUNGS, TOM, predict_human
from ms_highway.planning.human_models import JointPlan, Naive, TheoryOfMind, Turn

__all__ = ["CrowdSwitching", "OneStepGains", "crowd_switching"]


@dataclass(frozen=True)
class _Turn(Turn):
    """The human plans as the crowd's plans predict it, by the planner's solver."""

    def predict(
        self, game: Game, state: Float[jax.Array, "cars 4"], start: JointPlan | None = None
    ) -> Float[jax.Array, "steps 2"]:
        return predict_human(Crowd(game, jnp.asarray(game.human.weights)[None]), state, jnp.int32(0))


def crowd_switching(costs: CrowdCosts, price: float, tolerance: float = TRUST_TOLERANCE) -> "CrowdSwitching":
    """Return Algorithm 1 for each human, with the time that a human adds under each rung, at a lambda."""
    return CrowdSwitching(Switching(costs.each, price, (Naive(), _Turn(), TheoryOfMind()), trust_tolerance=tolerance))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CrowdSwitching:
    """Apply Algorithm 1 to the game of the robot with each human, in which all others keep their velocity.

    Gains are additive: what one human's rung gains does not depend on the rungs of others. They are Algorithm 1's own,
    over the rung in use and less the price of its time. As with one human, the first step is planned naively.

    Attributes:
        switching: of one human, with the time that a human adds under each rung as its costs.
    """

    switching: Switching

    def choose(self, crowd: Crowd, memory: CrowdMemory, outcome: CrowdOutcome) -> CrowdDecision:
        """See `ms_highway.metareasoning.crowd.rule.CrowdRule`."""

        def one(human: Int[jax.Array, ""]) -> Decision:
            game, seen = _with_human(crowd, outcome, human)
            own = Memory(jnp.asarray(memory.rungs)[human], memory.step, jnp.asarray(memory.last_check)[human])
            return decide_by(self.switching, game, own, seen)

        def all_humans() -> CrowdDecision:
            each = jax.lax.map(one, jnp.arange(crowd.humans))
            after = CrowdMemory(each.memory.rung, now, each.memory.last_check, memory.seed)
            return CrowdDecision(after, each.gains, each.failed.any())

        now = memory.step + 1
        unknown = jnp.full((crowd.humans, len(RUNGS)), jnp.nan)
        first = CrowdDecision(jax.tree.map(jnp.asarray, memory)._replace(step=now), unknown, jnp.bool(False))
        return jax.lax.cond(memory.step > 0, all_humans, lambda: first)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class OneStepGains:
    """Estimate what theory of mind gains over naive for every human, as Algorithm 1 does, in every step.

    The quadratic expansion of Algorithm 1 around the executed controls tells what the robot would have earned in the
    last step under the rung that was not in use. Turn is not estimated: its prediction takes as long as a plan by it.
    Nothing is chosen; for `ms_highway.metareasoning.crowd.budget.Budget`.

    Attributes:
        switching: of one human; its costs, price and cooldown are not used.
    """

    switching: Switching

    def choose(self, crowd: Crowd, memory: CrowdMemory, outcome: CrowdOutcome) -> CrowdDecision:
        """See `ms_highway.metareasoning.crowd.rule.CrowdRule`; before the first step, all gains are unknown."""

        def one(human: Int[jax.Array, ""]) -> Float[jax.Array, "rungs"]:
            game, seen = _with_human(crowd, outcome, human)
            uses_tom = jnp.asarray(memory.rungs)[human] == TOM
            gain = _gain_of_tom(self.switching, game, seen, uses_tom)
            return jnp.full(len(RUNGS), jnp.nan).at[jnp.array([NAIVE, TOM])].set(jnp.stack([0.0 * gain, gain]))

        unknown = jnp.full((crowd.humans, len(RUNGS)), jnp.nan)
        gains = jax.lax.cond(memory.step > 0, lambda: jax.lax.map(one, jnp.arange(crowd.humans)), lambda: unknown)
        return CrowdDecision(memory._replace(step=memory.step + 1), gains, jnp.bool(False))


def _gain_of_tom(
    switching: Switching, game: Game, seen: Outcome, uses_tom: Bool[jax.Array, ""]
) -> Float[jax.Array, ""]:
    """Return what the robot earns with theory of mind in the last step, less what it earns naively."""
    before, _, robot, human, reward = map(jnp.asarray, seen[:5])
    expansion = switching.expand(game, before, robot, human)
    kept = Naive().predict(game, before)[0]
    expected = jnp.where(uses_tom, kept, human)  # by the other model
    influence = jnp.where(uses_tom, 0.0, expansion.influence)
    change = change_of_control(expansion, human, expected, influence, switching)
    earned = switching.earned(game, before, robot + change, human + expansion.influence @ change)
    return jnp.where(uses_tom, reward - earned, earned - reward)


def _with_human(crowd: Crowd, outcome: CrowdOutcome, human: Int[jax.Array, ""]) -> tuple[Game, Outcome]:
    """Return the game of the robot with one human, and the outcome in it."""
    game, before = pair(crowd, jnp.asarray(outcome.before), human)
    _, after = pair(crowd, jnp.asarray(outcome.after), human)
    plan = JointPlan(outcome.plan.robot, jnp.asarray(outcome.plan.humans)[human])
    executed = jnp.asarray(outcome.humans)[human]
    return game, Outcome(before, after, jnp.asarray(outcome.robot), executed, jnp.asarray(outcome.reward), plan)
