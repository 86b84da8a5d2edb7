"""Decide which human model is worth its time, by the paper's Algorithm 1 with the one-step estimate of Sec. III-D.

After a step with one rung of the ladder, a quadratic expansion of the one-step rewards around the executed controls
estimates the robot's control under another rung and its reward. All controls are scaled, see `ms_highway.game.game`.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar, NamedTuple

import jax
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int

from ms_highway.game.dynamics import keep_velocity, step
from ms_highway.game.features import reward
from ms_highway.game.game import Game, swap_players
from ms_highway.game.reward import Reward
from ms_highway.game.scene import Scene
from ms_highway.metareasoning.rule import Decision, Memory, Outcome, check_costs
from ms_highway.optimization.second_derivatives import jacobian_and_hessian, response
from ms_highway.optimization.trust_region import trust_region_step
from ms_highway.planning.human_models import HumanModel
from ms_highway.runtime.arrays import Array

__all__ = ["RELEASED_TRUST_TOLERANCE", "Switching", "decide"]

RELEASED_TRUST_TOLERANCE = 0.05
"""Share of the trust radius within which the released code's solver stops."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Switching:
    """The numbers of Algorithm 1.

    Attributes:
        costs: array [rungs] of T(M), planning time of each rung [s]; NaN if unknown: then no gain is estimated, and the
            rung stays.
        price: lambda, reward per second of planning.
        trust_radius: longest change of the scaled control for which the expansion is trusted.
        trust_tolerance: of the step's length, as a share of the radius: 0.001, in the released code 0.05.
        cooldown: least number of steps between two downward checks of the same rung.
        ladder: tuple of human models, cheapest first, see `ms_highway.planning.human_models.ladder` (static).
    """

    costs: Float[Array, "rungs"]
    price: float | Float[Array, ""]
    ladder: tuple[HumanModel, ...] = field(metadata={"static": True})
    trust_radius: float | Float[Array, ""] = 1.5
    trust_tolerance: float | Float[Array, ""] = 1e-3
    cooldown: int | Int[Array, ""] = 3
    chooses_first: ClassVar[bool] = False
    network: ClassVar[None] = None

    def look(self, game: Game, memory: Memory, outcome: Outcome) -> Float[jax.Array, "2"]:
        """Estimate the gains of going up and down; NaN where none is needed."""
        return _gains(self, game, memory, outcome.before, outcome.robot, outcome.human, outcome.reward)

    def choose(self, memory: Memory, seen: Float[jax.Array, "2"]) -> Decision:
        """Take a step that gains: to the top of the ladder, or one rung down."""
        up, down = seen
        rung, top = memory.rung, len(self.ladder) - 1
        goes_up, checks, now = up > 0, _checks(self, memory), memory.step + 1
        chosen = jnp.where(goes_up, top, jnp.where(down > 0, rung - 1, rung))
        last_check = jnp.where(checks & ~goes_up, jnp.asarray(memory.last_check).at[rung].set(now), memory.last_check)
        rungs = jnp.arange(top + 1)
        gains = jnp.where(rungs == rung - 1, down, jnp.where((rungs == top) & (rung < top), up, jnp.nan))
        return Decision(Memory(chosen, now, last_check), gains, jnp.bool(False))


class _Expansion(NamedTuple):
    """The robot's one-step reward to second order in both first controls, and the human's response."""

    robot: Float[jax.Array, "2"]  # d r_R / d u_R
    human: Float[jax.Array, "2"]  # d r_R / d u_H
    robot_robot: Float[jax.Array, "2 2"]
    robot_human: Float[jax.Array, "2 2"]
    human_human: Float[jax.Array, "2 2"]
    influence: Float[jax.Array, "2 2"]  # J1 = d u_H / d u_R


@jax.jit
def decide(
    switching: Switching,
    game: Game,
    memory: Memory,
    state: Float[jax.Array, "cars 4"],
    robot: Float[jax.Array, "2"],
    human: Float[jax.Array, "2"],
    observed_reward: Float[jax.Array, ""],
) -> Decision:
    """Choose the rung of the coming step from the outcome of the last one.

    Up, tried at every step below the top: straight to the top rung, as if it had predicted the human control that
    was observed. Down, tried if not gone up and if this rung's last check is ``cooldown`` steps ago: one rung, with
    that rung's own prediction and no influence. A positive gain switches.

    Args:
        switching: ladder, costs, lambda, trust region and cooldown.
        game: scene, rewards and motion.
        memory: rung that the last step was planned with, and the checks made so far.
        state: all cars before the last step.
        robot: scaled control that the robot executed in it.
        human: scaled control that the human was observed to execute in it.
        observed_reward: the robot's reward after it.

    Raises:
        ValueError: if there is not one cost for each rung of the ladder.
    """
    return switching.choose(memory, _gains(switching, game, memory, state, robot, human, observed_reward))


def _checks(switching: Switching, memory: Memory) -> Bool[Array, ""]:
    """Return whether the rung below may be checked now."""
    rung = memory.rung
    return (rung > 0) & (memory.step + 1 - jnp.asarray(memory.last_check)[rung] >= switching.cooldown)


@jax.jit
def _gains(
    switching: Switching,
    game: Game,
    memory: Memory,
    state: Float[jax.Array, "cars 4"],
    robot: Float[jax.Array, "2"],
    human: Float[jax.Array, "2"],
    observed_reward: Float[jax.Array, ""],
) -> Float[jax.Array, "2"]:
    """Estimate the gains of going up and down, for `decide`; NaN where none is needed."""
    check_costs(switching)
    ladder, costs = switching.ladder, jnp.asarray(switching.costs)
    rung, top = memory.rung, len(ladder) - 1
    climbs, checks = rung < top, _checks(switching, memory)
    none, not_estimated = jnp.zeros((2, 2)), jnp.float32(jnp.nan)

    def estimate() -> tuple[Float[jax.Array, ""], Float[jax.Array, ""]]:
        expansion = _expand(game, state, robot, human)

        def gain(
            expected: Float[jax.Array, "2"], influence: Float[jax.Array, "2 2"], alternative: Int[jax.Array, ""] | int
        ) -> Float[jax.Array, ""]:
            change = _change_of_control(expansion, human, expected, influence, switching)
            earned = _earned(game, game.scene, game.robot, state, robot + change, human + expansion.influence @ change)
            return earned - observed_reward - switching.price * (costs[alternative] - costs[rung])

        def gain_down() -> Float[jax.Array, ""]:
            below = jnp.maximum(rung - 1, 0)
            predictions = [partial(model.predict, game, state) for model in ladder[: max(top, 1)]]
            return gain(jax.lax.switch(below, predictions)[0], none, below)

        influence = expansion.influence if ladder[top].responds else none
        up = jax.lax.cond(climbs, lambda: gain(human, influence, top), lambda: not_estimated)
        return up, jax.lax.cond(checks & ~(up > 0), gain_down, lambda: not_estimated)

    return jnp.stack(jax.lax.cond(climbs | checks, estimate, lambda: (not_estimated, not_estimated)))


def _earned(
    game: Game,
    scene: Scene,
    parameters: Reward,
    state: Float[jax.Array, "cars 4"],
    own: Float[jax.Array, "2"],
    partner: Float[jax.Array, "2"],
) -> Float[jax.Array, ""]:
    """Compute car 0's reward after one step with these controls; the others keep their velocity."""
    controls = jnp.stack([own, partner]) * game.planner.control_scale
    others = keep_velocity(game.dynamics, state[2:])
    return reward(scene, parameters, step(game.dynamics, state, jnp.concatenate([controls, others])))


def _expand(
    game: Game, state: Float[jax.Array, "cars 4"], robot: Float[jax.Array, "2"], human: Float[jax.Array, "2"]
) -> _Expansion:
    """Differentiate the one-step rewards at the executed controls; J1 = -(d2r_H/du_H2)^-1 d2r_H/du_H du_R.

    Both rewards are expanded in one batch, each from its own car's side. The terms of obstacles, other cars and another
    leader do not depend on the partner's control and are left out of derivatives in it, unless there is a user-defined
    feature, which may depend on everything.
    """
    pair, cars = game.scene, len(state)
    if not game.robot.own:
        pair, cars = replace(pair, obstacles=pair.obstacles[:0], leader=1 if pair.leader == 1 else None), 2

    def derivatives(
        parameters: Reward,
        state: Float[jax.Array, "cars 4"],
        own: Float[jax.Array, "2"],
        partner: Float[jax.Array, "2"],
    ) -> tuple[jax.Array, ...]:
        def in_partner(both: Float[jax.Array, "2 2"]) -> tuple[jax.Array, jax.Array]:
            slope = jax.jacfwd(lambda partner: _earned(game, pair, parameters, state[:cars], both[0], partner))(both[1])
            return slope, slope

        own_slope, own_bend = jacobian_and_hessian(
            lambda own: _earned(game, game.scene, parameters, state, own, partner)
        )(own)
        bend, partner_slope = jax.jacfwd(in_partner, has_aux=True)(jnp.stack([own, partner]))
        return own_slope, partner_slope, own_bend, bend[:, 0].T, bend[:, 1]

    rewards = jax.tree.map(lambda *numbers: jnp.stack(numbers), game.robot, game.human)
    states = jnp.stack([state, swap_players(game, state)[1]])
    controls = jnp.stack([robot, human])
    own, partner, own_own, own_partner, partner_partner = jax.vmap(derivatives)(
        rewards, states, controls, controls[::-1]
    )
    human_bend = own_own[1] - jnp.diag(game.human.comfort)
    influence = response(game.influence, human_bend, own_partner[1])
    return _Expansion(own[0], partner[0], own_own[0], own_partner[0], partner_partner[0], influence)


def _change_of_control(
    expansion: _Expansion,
    human: Float[jax.Array, "2"],
    expected: Float[jax.Array, "2"],
    influence: Float[jax.Array, "2 2"],
    switching: Switching,
) -> Float[jax.Array, "2"]:
    """Return the best first control under another model, less the executed one: ``delta u``.

    With d = u' - u_H and J' the model's influence, the expansion is ``du^T A du / 2 + B du`` with
    ``A = r_RR + r_RH J' + (r_RH J')^T + J'^T r_HH J'`` and ``B = r_R + J'^T r_H + r_RH d + J'^T r_HH d``,
    subscripts being derivatives of r_R.
    """
    surprise = expected - human
    cross = expansion.robot_human @ influence
    quadratic = expansion.robot_robot + cross + cross.T + influence.T @ expansion.human_human @ influence
    linear = expansion.robot + expansion.robot_human @ surprise
    linear += influence.T @ (expansion.human + expansion.human_human @ surprise)
    return trust_region_step(quadratic, linear, switching.trust_radius, switching.trust_tolerance)
