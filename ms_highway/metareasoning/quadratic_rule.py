"""Check rungs in Algorithm 1's order, by gains that a quadratic expansion of the rewards estimates.

All controls are scaled, see `ms_highway.game.game`, and ravelled: n = 2 steps numbers of each player.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
from jax import numpy as jnp

from ms_highway.game.game import Game, each_human
from ms_highway.metareasoning.rule import NOT_ESTIMATED, Decision, Memory, Outcome, check_costs, with_human
from ms_highway.optimization.trust_region import trust_region_step
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import HumanModel
from ms_highway.runtime.arrays import Control, HumansControl, Index, Matrix, Scalar, State, Vector

TRUST_TOLERANCE = 1e-3
"""Share of the trust radius within which the length of a step is found."""


class RewardExpansion(NamedTuple):
    """The robot's reward to second order in the controls of both, and the human's response."""

    robot: Vector  # d r_R / d u_R
    human: Vector  # d r_R / d u_H
    robot_robot: Matrix
    robot_human: Matrix
    human_human: Matrix
    influence: Matrix  # J = d u_H / d u_R


@dataclass(frozen=True)
class QuadraticRule(ABC):
    """The numbers of Algorithm 1, and its order of checks; for each human alone, in the robot's game with it.

    Up, checked at every step below the top: straight to the top rung, as if it had predicted the human control that
    was observed. Down, checked if not gone up and if this rung's last check is ``cooldown`` steps ago: one rung, with
    that rung's own prediction and no influence. A positive gain switches. The first step is planned with the first
    rung. Gains are additive: what one human's rung gains does not depend on the rungs of others.

    Attributes:
        costs: planning time of each rung [s]; NaN if unknown: then no gain is estimated, and the rung stays.
        price: lambda, reward per second of planning.
        trust_radius: longest change of the scaled controls for which the expansion is trusted.
        trust_tolerance: of the step's length, as a share of the radius: 0.001, in the released code 0.05.
        cooldown: least number of steps between two downward checks of the same rung.
        ladder: tuple of human models, cheapest first, see `ms_highway.planning.human_models.ladder` (static).
    """

    costs: Costs
    price: Scalar
    ladder: tuple[HumanModel, ...] = field(metadata={"static": True})
    trust_radius: Scalar = 1.5
    trust_tolerance: Scalar = TRUST_TOLERANCE
    cooldown: Index = 3

    @abstractmethod
    def executed(self, game: Game, outcome: Outcome) -> tuple[Vector, Vector, Scalar]:
        """Return the controls of robot and human to expand around, and what the robot earned with them."""

    @abstractmethod
    def expand(self, game: Game, state: State, robot: Vector, human: Vector) -> RewardExpansion:
        """Expand both players' rewards around the controls of both."""

    @abstractmethod
    def earned(self, game: Game, state: State, robot: Vector, human: Vector) -> Scalar:
        """Compute what the robot earns with these controls."""

    def look(self, game: Game, memory: Memory, outcome: Outcome) -> HumansControl:
        """Estimate every human's gains of going up and down; `NOT_ESTIMATED` where none is needed."""

        def one(human: Index) -> Control:
            alone, seen = with_human(game, outcome, human)
            rung, checks = jnp.asarray(memory.rungs)[human], jnp.asarray(memory.last_check)[human]
            state = jnp.asarray(seen.before)
            return estimate_gains(self, alone, Memory(rung, memory.step, checks), state, *self.executed(alone, seen))

        return each_human(game, one)

    def choose(self, memory: Memory, seen: HumansControl) -> Decision:
        """Take a step that gains: to the top of the ladder, or one rung down."""
        up, down, rungs = seen[:, 0], seen[:, 1], jnp.asarray(memory.rungs)
        goes_up, now, top = up > 0, memory.step + 1, len(self.ladder) - 1
        chosen = jnp.where(goes_up, top, jnp.where(down > 0, rungs - 1, rungs))
        below, places = rungs[:, None], jnp.arange(top + 1)
        last = jnp.take_along_axis(jnp.asarray(memory.last_check), below, axis=1)[:, 0]
        checked = (self.checks_below(rungs, memory.step, last) & ~goes_up)[:, None] & (places == below)
        last_check = jnp.where(checked, now, memory.last_check)
        up_gains = jnp.where((places == top) & (below < top), up[:, None], NOT_ESTIMATED)
        gains = jnp.where(places == below - 1, down[:, None], up_gains)
        return Decision(Memory(chosen, now, last_check), gains, jnp.bool(False))

    def checks_below(self, rung: Any, step: Index, last_check: Any) -> Any:
        """Return whether the rung below may be checked now, after a last check of this one."""
        return (rung > 0) & (step > 0) & (step + 1 - last_check >= self.cooldown)


@jax.jit
def estimate_gains(
    rule: QuadraticRule, game: Game, memory: Memory, state: State, robot: Vector, human: Vector, reward: Scalar
) -> Control:
    """Estimate the gains of going up and down about one human; `NOT_ESTIMATED` where none is needed.

    Args:
        rule: ladder, costs, lambda, trust region and cooldown; expands and evaluates the rewards.
        game: of the robot with this human.
        memory: of this human, without an axis: rung that the last step was driven with, and the checks made so far.
        state: all cars before the last step.
        robot: scaled controls of the robot from there on, ravelled.
        human: scaled controls of the human from there on, ravelled.
        reward: the robot's, under these controls.

    Raises:
        ValueError: if there is not one cost for each rung of the ladder.
    """
    check_costs(rule)
    ladder, costs, steps = rule.ladder, jnp.asarray(rule.costs.each), len(robot) // 2
    rung, top = memory.rungs, len(ladder) - 1
    climbs = (rung < top) & (memory.step > 0)
    checks = rule.checks_below(rung, memory.step, jnp.asarray(memory.last_check)[rung])
    none, not_estimated = jnp.zeros((len(robot), len(robot))), jnp.float32(NOT_ESTIMATED)

    def estimate() -> tuple[Scalar, Scalar]:
        expansion = rule.expand(game, state, robot, human)

        def gain(expected: Vector, influence: Matrix, alternative: Index) -> Scalar:
            change = change_of_control(expansion, human, expected, influence, rule)
            earned = rule.earned(game, state, robot + change, human + expansion.influence @ change)
            saved = costs[rung] - costs[alternative]
            return jnp.where(jnp.isnan(saved), not_estimated, earned - reward + steps * rule.price * saved)

        def gain_down() -> Scalar:
            below = jnp.maximum(rung - 1, 0)
            predictions = [partial(model.predict, game, state) for model in ladder[: max(top, 1)]]
            return gain(jax.lax.switch(below, predictions)[:steps].ravel(), none, below)

        influence = expansion.influence if ladder[top].responds else none
        up = jax.lax.cond(climbs, lambda: gain(human, influence, top), lambda: not_estimated)
        return up, jax.lax.cond(checks & ~(up > 0), gain_down, lambda: not_estimated)

    return jnp.stack(jax.lax.cond(climbs | checks, estimate, lambda: (not_estimated, not_estimated)))


def change_of_control(
    expansion: RewardExpansion, human: Vector, expected: Vector, influence: Matrix, rule: QuadraticRule
) -> Vector:
    """Return the best controls under another model, less the present ones: ``delta u``.

    With d = u' - u_H and J' the model's influence, the expansion is ``du^T A du / 2 + B du`` with
    ``A = r_RR + r_RH J' + (r_RH J')^T + J'^T r_HH J'`` and ``B = r_R + J'^T r_H + r_RH d + J'^T r_HH d``,
    subscripts being derivatives of r_R.
    """
    surprise = expected - human
    cross = expansion.robot_human @ influence
    quadratic = expansion.robot_robot + cross + cross.T + influence.T @ expansion.human_human @ influence
    linear = expansion.robot + expansion.robot_human @ surprise
    linear += influence.T @ (expansion.human + expansion.human_human @ surprise)
    return trust_region_step(quadratic, linear, rule.trust_radius, rule.trust_tolerance)
