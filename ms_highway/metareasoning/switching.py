"""Decide which human model is worth its time, by the paper's Algorithm 1 with the one-step estimate of Sec. III-D.

After a step with one rung of the ladder, a quadratic expansion of the one-step rewards around the executed controls
estimates the robot's control under another rung and its reward. All controls are scaled, see `ms_highway.game.game`.
"""

from dataclasses import dataclass
from typing import ClassVar

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.dynamics import keep_velocity, step
from ms_highway.game.features import reward
from ms_highway.game.game import Game, swap_players
from ms_highway.game.reward import Reward
from ms_highway.game.scene import Scene
from ms_highway.metareasoning.quadratic_rule import QuadraticRule, RewardExpansion
from ms_highway.metareasoning.rule import Outcome
from ms_highway.optimization.second_derivatives import jacobian_and_hessian, response
from ms_highway.runtime.arrays import Control, Scalar, State, Vector

RELEASED_TRUST_TOLERANCE = 0.05
"""Share of the trust radius within which the released code's solver stops."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Switching(QuadraticRule):
    """Algorithm 1: expand the rewards of one step around the executed controls; for its numbers see `QuadraticRule`."""

    in_one_kernel: ClassVar[bool] = True

    def executed(self, game: Game, outcome: Outcome) -> tuple[Vector, Vector, Scalar]:
        """See `QuadraticRule.executed`: the controls of the last step."""
        return outcome.robot, outcome.humans[0], outcome.reward

    def expand(self, game: Game, state: State, robot: Control, human: Control) -> RewardExpansion:
        """See `QuadraticRule.expand`."""
        return _expand(game, state, robot, human)

    def earned(self, game: Game, state: State, robot: Control, human: Control) -> Scalar:
        """Compute the robot's reward after one step, see `QuadraticRule.earned`."""
        return _earned(game, game.scene, game.robot, state, robot, human)


def _earned(game: Game, scene: Scene, parameters: Reward, state: State, own: Control, partner: Control) -> Scalar:
    """Compute car 0's reward after one step with these controls; the others keep their velocity."""
    controls = jnp.stack([own, partner]) * game.planner.control_scale
    others = keep_velocity(game.dynamics, state[2:])
    return reward(scene, parameters, step(game.dynamics, state, jnp.concatenate([controls, others])))


def _expand(game: Game, state: State, robot: Control, human: Control) -> RewardExpansion:
    """Differentiate the one-step rewards at the executed controls; J1 = -(d2r_H/du_H2)^-1 d2r_H/du_H du_R.

    Both rewards are expanded in one batch, each from its own car's side. The terms of obstacles, other cars and another
    leader do not depend on the partner's control and are left out of derivatives in it, unless there is a user-defined
    feature, which may depend on everything.
    """
    pair, cars = game.scene, len(state)
    if not game.robot.own:
        pair, cars = pair.of_pair(), 2

    def derivatives(parameters: Reward, state: State, own: Control, partner: Control) -> tuple[jax.Array, ...]:
        def in_partner(both: Float[jax.Array, "2 2"]) -> tuple[jax.Array, jax.Array]:
            slope = jax.jacfwd(lambda partner: _earned(game, pair, parameters, state[:cars], both[0], partner))(both[1])
            return slope, slope

        own_slope, own_bend = jacobian_and_hessian(
            lambda own: _earned(game, game.scene, parameters, state, own, partner)
        )(own)
        bend, partner_slope = jax.jacfwd(in_partner, has_aux=True)(jnp.stack([own, partner]))
        return own_slope, partner_slope, own_bend, bend[:, 0].T, bend[:, 1]

    rewards = jax.tree.map(lambda *numbers: jnp.stack(numbers), game.robot, game.human())
    states = jnp.stack([state, swap_players(game, state)[1]])
    controls = jnp.stack([robot, human])
    own, partner, own_own, own_partner, partner_partner = jax.vmap(derivatives)(
        rewards, states, controls, controls[::-1]
    )
    human_bend = own_own[1] - jnp.diag(game.humans.comfort)
    influence = response(game.influence, human_bend, own_partner[1])
    return RewardExpansion(own[0], partner[0], own_own[0], own_partner[0], partner_partner[0], influence)
