r"""Compare planners and agents of your own with the package's, in one table.

A planner is a function of the robot's game and the state of all cars in SI units; an
agent is a function of the observation, or has the method ``predict`` of
stable-baselines3. Run it, or make both known to any command::

    python notebooks/examples/agents.py
    ms-highway --import notebooks.examples.agents compare merger-v1 \
      --controllers merges coasts --out results/own
    ms-highway --import notebooks.examples.agents video merger-v1 \
      --controller merges --out results/merges.gif

Prints::

      controller  reward  collision_episodes
    0     merges   -3.70                   1
    1     coasts    0.98                   0
    2      naive    5.05                   0
    3  learned:1    6.15                   0
"""

import numpy as np

import ms_highway
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.runner import read, run
from ms_highway.experiments.summary import summary
from ms_highway.game.dynamics import keep_velocity


def merges(game, state):
    """Steer to the target lane, whoever is there; return curvature [1/m] and
    acceleration before friction [m/s^2].
    """
    _, y, heading, speed = state[0]
    wanted = np.clip(0.05 * (float(game.scene.target_lane) - y), -0.1, 0.1)
    curvature = np.clip(
        (wanted - heading) / (speed * float(game.world.time_step)), -0.015, 0.015
    )
    return keep_velocity(game.world, state[0]) + np.array([curvature, 0.0])


ms_highway.add_driver("merges", merges)
ms_highway.add_agent(
    "coasts", lambda observation: [0.0, 0.0], {"action": {"type": "ContinuousAction"}}
)

if __name__ == "__main__":
    comparison = Comparison(
        {"merger-v1": ["merges", "coasts", "naive", "learned:1"]}, seeds=10
    )
    print(*run(comparison, "results/own"))  # episodes that are done
    print(
        summary(read(comparison, "results/own"))[
            ["controller", "reward", "collision_episodes"]
        ].round(2)
    )
