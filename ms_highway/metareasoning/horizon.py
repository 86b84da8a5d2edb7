"""Decide which human model is worth its time, by the paper's estimate over the whole horizon of Sec. III-C.

Algorithm 1, `ms_highway.metareasoning.switching`, is its one-step simplification: with a horizon of one step, both
estimate the same gains.
"""

from dataclasses import dataclass, replace

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.game import Game, move, step_rewards, swap_players, total_reward, trajectory_reward
from ms_highway.game.reward import Reward
from ms_highway.metareasoning.quadratic_rule import QuadraticRule, RewardExpansion
from ms_highway.metareasoning.rule import Outcome
from ms_highway.optimization.second_derivatives import response, second_order_expansion
from ms_highway.runtime.arrays import Controls, Matrix, Scalar, State, Trajectory, Vector


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class WholeHorizon(QuadraticRule):
    """Expand the rewards of a whole plan in all K controls of both; for its numbers see `QuadraticRule`.

    * The rewards R_R and R_H over K steps are expanded around the last plan, from the state in which it was made: the
      robot's controls, the first as executed, and the human's as expected, the first as observed. What the human does
      later has not been observed, so that the plan's expectation stands for it.
    * Going up, the alternative expects these same human controls, and their response to the robot's over the horizon,
      ``J = du_H / du_R = -(d2R_H / du_H2)^-1 d2R_H / du_H du_R``, 2K x 2K. Going down, it expects the K controls that
      the rung below predicts, and no response.
    * ``delta u`` maximises the expansion within the trust region, whose radius bounds all 2K numbers together.
    * The gain is R_R after that change, to which the human responds by J, less what the last plan earns: its first
      reward as observed, the others as expected.
    * The meta-MDP pays ``lambda T(M)`` for every step. Driving the K steps takes K plans, so that the gain is less
      ``K lambda (T' - T)``.
    """

    def executed(self, game: Game, outcome: Outcome) -> tuple[Vector, Vector, Scalar]:
        """See `QuadraticRule.executed`: the controls of the last plan, the first ones as executed and observed."""
        state, plan = jnp.asarray(outcome.before), outcome.plan
        robot = jnp.asarray(plan.robot).at[0].set(outcome.robot)
        human = jnp.asarray(plan.humans[0]).at[0].set(outcome.humans[0])
        expected = step_rewards(game, state, move(game, state[0], robot), move(game, state[1], human)[None])
        return robot.ravel(), human.ravel(), outcome.reward + jnp.sum(expected[1:])

    def expand(self, game: Game, state: State, robot: Vector, human: Vector) -> RewardExpansion:
        """See `QuadraticRule.expand`. Both rewards are expanded in one batch, each from its own car's side."""
        n, steps = len(robot), len(robot) // 2

        def derivatives(
            parameters: Reward, state: State, controls: Float[jax.Array, "players n"]
        ) -> tuple[Vector, Matrix]:
            def paths(controls: Controls) -> Trajectory:
                own, partner = jnp.split(controls, 2)
                return jnp.concatenate([move(game, state[0], own), move(game, state[1], partner)])

            def earned(paths: Trajectory) -> Scalar:
                own, partner = jnp.split(paths, 2)
                return trajectory_reward(replace(game, robot=parameters), state, own, partner[None])

            gradient, hessian, _ = second_order_expansion(paths, earned, controls.reshape(-1, 2))
            return gradient, hessian

        rewards = jax.tree.map(lambda *numbers: jnp.stack(numbers), game.robot, game.human())
        states = jnp.stack([state, swap_players(game, state)[1]])
        controls = jnp.stack([jnp.stack([robot, human]), jnp.stack([human, robot])])
        slopes, bends = jax.vmap(derivatives)(rewards, states, controls)
        human_bend = bends[1, :n, :n] - jnp.diag(jnp.tile(jnp.asarray(game.humans.comfort), steps))
        influence = response(game.influence, human_bend, bends[1, :n, n:])
        bend = bends[0]
        return RewardExpansion(slopes[0, :n], slopes[0, n:], bend[:n, :n], bend[:n, n:], bend[n:, n:], influence)

    def earned(self, game: Game, state: State, robot: Vector, human: Vector) -> Scalar:
        """Sum the robot's rewards over the horizon, see `QuadraticRule.earned`."""
        return total_reward(game, state, robot.reshape(-1, 2), human.reshape(1, -1, 2))
