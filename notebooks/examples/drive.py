"""Drive an episode of Merger; print which model the robot plans with, and why.

Run::

    python notebooks/examples/drive.py
"""

import gymnasium as gym

# Registers the environments.
import ms_highway  # noqa: F401

env = gym.make(
    "ms-highway/merger-v1",
    render_mode="rgb_array",
    config={
        "controller": {"type": "learned", "lambda": 1.0}
    },  # the default; or {"type": "fixed", "model": "tom"}
)
observation, info = env.reset(seed=0)
done = False
while not done:
    observation, reward, terminated, truncated, info = env.step(
        0
    )  # the robot drives itself
    done = terminated or truncated
    print(
        info["model"],
        round(reward, 2),
        info["gains"],
        f"{1e3 * info['timing'].planning_seconds:.1f} ms",
    )
frame = env.render()  # the road from above, with plan, prediction and a panel
