r"""Let a human drive as you say, and let the robot predict it by a model of yours.

Both are pure functions in SI units. The human brakes by 2 m/s^2 whenever the robot is
beside it or just ahead; the model knows that. Run it, or make both known to any
command::

    python notebooks/examples/own_human.py
    ms-highway --import notebooks.examples.own_human compare merger-v1 \
      --set human_driver=polite \
      --set ladder=naive,expects_politeness,tom \
      --set costs=naive=0.0007,expects_politeness=0.0007,tom=0.0011 \
      --controllers naive expects_politeness tom --out results/polite

Theory of mind counts on a response that does not come. Prints::

               controller  reward
    0               naive    4.92
    1  expects_politeness    5.04
    tom collides in 30 of 30 episodes
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

import ms_highway
from ms_highway.experiments.batch import simulated
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.summary import summary
from ms_highway.game.dynamics import keep_velocity, step


def polite(game, state):
    """Return the control of car 0: curvature [1/m] and acceleration before friction
    [m/s^2].
    """
    ahead = state[1, 0] - state[0, 0]  # of the robot, from centre to centre [m]
    braking = jnp.where((ahead > -5.0) & (ahead < 15.0), 2.0, 0.0)
    return keep_velocity(game.world, state[0]) - jnp.stack([0.0, braking])


@dataclass(frozen=True)
class ExpectsPoliteness(ms_highway.PredictedHuman):
    """The human drives as `polite`, and all others keep their velocity."""

    name = "expects_politeness"

    def predict(self, game, state, start=None):
        """Return the human's controls over the horizon, [steps, 2]; here the robot is
        car 0 and the human car 1.
        """

        def one(state, _):
            control = polite(game, jnp.concatenate([state[1::-1], state[2:]]))
            return (
                step(
                    game.dynamics,
                    state,
                    keep_velocity(game.dynamics, state).at[1].set(control),
                ),
                control,
            )

        return jax.lax.scan(one, jnp.asarray(state), None, game.planner.horizon)[1]


ms_highway.add_driver("polite", polite)
ms_highway.register(ExpectsPoliteness(), before="turn")

if __name__ == "__main__":
    seconds = {"naive": 0.0007, "expects_politeness": 0.0007, "tom": 0.0011}
    config = {"human_driver": "polite", "ladder": list(seconds), "costs": seconds}
    comparison = Comparison({"merger-v1": list(seconds)}, seeds=30, config=config)
    table = summary(simulated(comparison))
    is_tom = table["controller"] == "tom"
    collided = table["collision_episodes"][is_tom].item()
    print("reward per step")
    print(table[~is_tom][["controller", "reward"]].round(2))
    print(f"tom collides in {collided} of {comparison.seeds} episodes")
