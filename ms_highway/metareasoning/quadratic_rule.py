"""Check rungs in Algorithm 1's order, by gains that a quadratic expansion of the rewards estimates.

All controls are scaled, see `ms_highway.game.game`, and ravelled: n = 2 steps numbers of each player.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar, NamedTuple

import jax
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int

from ms_highway.game.game import Game
from ms_highway.metareasoning.rule import Decision, Memory, Outcome, check_costs
from ms_highway.optimization.trust_region import trust_region_step
from ms_highway.planning.human_models import HumanModel
from ms_highway.runtime.arrays import Array

__all__ = ["TRUST_TOLERANCE", "Expansion", "QuadraticRule", "change_of_control", "estimate_gains"]


TRUST_TOLERANCE = 1e-3
"""Share of the trust radius within which the length of a step is found."""


class Expansion(NamedTuple):
    """The robot's reward to second order in the controls of both, and the human's response."""

    robot: Float[jax.Array, "n"]  # d r_R / d u_R
    human: Float[jax.Array, "n"]  # d r_R / d u_H
    robot_robot: Float[jax.Array, "n n"]
    robot_human: Float[jax.Array, "n n"]
    human_human: Float[jax.Array, "n n"]
    influence: Float[jax.Array, "n n"]  # J = d u_H / d u_R


@dataclass(frozen=True)
class QuadraticRule(ABC):
    """The numbers of Algorithm 1, and its order of checks.

    Up, checked at every step below the top: straight to the top rung, as if it had predicted the human control that
    was observed. Down, checked if not gone up and if this rung's last check is ``cooldown`` steps ago: one rung, with
    that rung's own prediction and no influence. A positive gain switches.

    Attributes:
        costs: array [rungs] of T(M), planning time of each rung [s]; NaN if unknown: then no gain is estimated, and the
            rung stays.
        price: lambda, reward per second of planning.
        trust_radius: longest change of the scaled controls for which the expansion is trusted.
        trust_tolerance: of the step's length, as a share of the radius: 0.001, in the released code 0.05.
        cooldown: least number of steps between two downward checks of the same rung.
        ladder: tuple of human models, cheapest first, see `ms_highway.planning.human_models.ladder` (static).
    """

    costs: Float[Array, "rungs"]
    price: float | Float[Array, ""]
    ladder: tuple[HumanModel, ...] = field(metadata={"static": True})
    trust_radius: float | Float[Array, ""] = 1.5
    trust_tolerance: float | Float[Array, ""] = TRUST_TOLERANCE
    cooldown: int | Int[Array, ""] = 3
    chooses_first: ClassVar[bool] = False
    network: ClassVar[None] = None
    in_one_kernel: ClassVar[bool]

    @abstractmethod
    def look(self, game: Game, memory: Memory, outcome: Outcome) -> Float[jax.Array, "2"]:
        """Estimate the gains of going up and down by `estimate_gains`; NaN where none is needed."""

    @abstractmethod
    def expand(
        self,
        game: Game,
        state: Float[jax.Array, "cars 4"],
        robot: Float[jax.Array, "n"],
        human: Float[jax.Array, "n"],
    ) -> Expansion:
        """Expand both players' rewards around the controls of both."""

    @abstractmethod
    def earned(
        self,
        game: Game,
        state: Float[jax.Array, "cars 4"],
        robot: Float[jax.Array, "n"],
        human: Float[jax.Array, "n"],
    ) -> Float[jax.Array, ""]:
        """Compute what the robot earns with these controls."""

    def choose(self, memory: Memory, seen: Float[jax.Array, "2"]) -> Decision:
        """Take a step that gains: to the top of the ladder, or one rung down."""
        up, down = seen
        rung, top = memory.rung, len(self.ladder) - 1
        goes_up, checks, now = up > 0, self.checks_below(memory), memory.step + 1
        chosen = jnp.where(goes_up, top, jnp.where(down > 0, rung - 1, rung))
        last_check = jnp.where(checks & ~goes_up, jnp.asarray(memory.last_check).at[rung].set(now), memory.last_check)
        rungs = jnp.arange(top + 1)
        gains = jnp.where(rungs == rung - 1, down, jnp.where((rungs == top) & (rung < top), up, jnp.nan))
        return Decision(Memory(chosen, now, last_check), gains, jnp.bool(False))

    def checks_below(self, memory: Memory) -> Bool[Array, ""]:
        """Return whether the rung below may be checked now."""
        rung = memory.rung
        return (rung > 0) & (memory.step + 1 - jnp.asarray(memory.last_check)[rung] >= self.cooldown)


@jax.jit
def estimate_gains(
    rule: QuadraticRule,
    game: Game,
    memory: Memory,
    state: Float[jax.Array, "cars 4"],
    robot: Float[jax.Array, "n"],
    human: Float[jax.Array, "n"],
    reward: Float[jax.Array, ""],
) -> Float[jax.Array, "2"]:
    """Estimate the gains of going up and down; NaN where none is needed.

    Args:
        rule: ladder, costs, lambda, trust region and cooldown; expands and evaluates the rewards.
        game: scene, rewards and motion.
        memory: rung that the last step was planned with, and the checks made so far.
        state: all cars before the last step.
        robot: scaled controls of the robot from there on.
        human: scaled controls of the human from there on.
        reward: the robot's, under these controls.

    Raises:
        ValueError: if there is not one cost for each rung of the ladder.
    """
    check_costs(rule)
    ladder, costs, steps = rule.ladder, jnp.asarray(rule.costs), len(robot) // 2
    rung, top = memory.rung, len(ladder) - 1
    climbs, checks = rung < top, rule.checks_below(memory)
    none, not_estimated = jnp.zeros((len(robot), len(robot))), jnp.float32(jnp.nan)

    def estimate() -> tuple[Float[jax.Array, ""], Float[jax.Array, ""]]:
        expansion = rule.expand(game, state, robot, human)

        def gain(
            expected: Float[jax.Array, "n"], influence: Float[jax.Array, "n n"], alternative: Int[jax.Array, ""] | int
        ) -> Float[jax.Array, ""]:
            change = change_of_control(expansion, human, expected, influence, rule)
            earned = rule.earned(game, state, robot + change, human + expansion.influence @ change)
            return earned - reward - steps * rule.price * (costs[alternative] - costs[rung])

        def gain_down() -> Float[jax.Array, ""]:
            below = jnp.maximum(rung - 1, 0)
            predictions = [partial(model.predict, game, state) for model in ladder[: max(top, 1)]]
            return gain(jax.lax.switch(below, predictions)[:steps].ravel(), none, below)

        influence = expansion.influence if ladder[top].responds else none
        up = jax.lax.cond(climbs, lambda: gain(human, influence, top), lambda: not_estimated)
        return up, jax.lax.cond(checks & ~(up > 0), gain_down, lambda: not_estimated)

    return jnp.stack(jax.lax.cond(climbs | checks, estimate, lambda: (not_estimated, not_estimated)))


def change_of_control(
    expansion: Expansion,
    human: Float[jax.Array, "n"],
    expected: Float[jax.Array, "n"],
    influence: Float[jax.Array, "n n"],
    rule: QuadraticRule,
) -> Float[jax.Array, "n"]:
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
