r"""Let the human of Merger drive for a feature of your own: to be alone on the road.

A feature is a function of one moment that any reward may weigh: that of a scenario,
`human_reward`, or a learned one (`ms-highway irl fit --learn`). Run it, or learn its
weight from recordings in a directory::

    python notebooks/examples/feature.py
    ms-highway --import notebooks.examples.feature irl fit --data us101 \
      --learn speed alone --out theta.json
"""

import gymnasium as gym
from jax import numpy as jnp

from ms_highway import add_feature

add_feature(
    "alone",
    lambda scene, own, others: (
        -jnp.sum(jnp.exp(-(((own.x - others.x) / scene.length_unit) ** 2)))
    ),
)

if __name__ == "__main__":
    driving = {
        "human_reward": {"speed": 2, "alone": 5},
        "controller": {"type": "fixed", "model": "naive"},
    }
    env = gym.make("ms-highway/merger-v0", config=driving)
    env.reset(seed=0)
    for _ in range(20):
        env.step(0)
    robot, human, *_ = env.unwrapped.car_states
    print(
        f"the human drives at {human[3]:.1f} m/s, {abs(human[0] - robot[0]):.1f} m from"
        " the robot"
    )
