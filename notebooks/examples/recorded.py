"""Drive in recorded traffic, among learned drivers who react, and record a video of it.

The recording of US-101 comes with the package; ``config["recording"]`` takes the file
of any other CommonRoad scenario of a highway, and ``config["ego"]`` the number of a
vehicle, to start in its place. Prints what came of it and writes
``videos/recorded-episode-0.mp4``; needs the extra ``video``. Run::

    python notebooks/examples/recorded.py
"""

import gymnasium as gym
from gymnasium.wrappers import RecordVideo

import ms_highway

ms_highway.low_latency()  # before anything is computed
ms_highway.keep_compilations()  # for the next time

config = {"recording": "us101", "traffic": "learned", "ego": "problem"}
env = ms_highway.drive(
    gym.make("ms-highway/recorded-v0", render_mode="rgb_array", config=config)
)
env = RecordVideo(
    env, "videos", name_prefix="recorded", fps=10
)  # the road moves at 10 Hz

env.reset(seed=0)
done = False
largest = 0.0
while not done:
    _, reward, terminated, truncated, info = env.step(None)  # the robot drives itself
    done = terminated or truncated
    largest = max(largest, info["road"]["acceleration"])
env.close()
print(f"{info['recorded']}, at most {largest:.1f} m/s^2")
