"""Drive a stock scene of highway-env at a speed and within a budget of one's own.

A video of it is recorded. Within 20 milliseconds per plan, the cars whose answers may
be worth most are predicted by the most expensive model. Prints a line per second and
writes ``videos/stock-road-episode-0.mp4``; needs the extra ``video``. Run::

    python notebooks/examples/stock_road.py
"""

from collections import Counter

import gymnasium as gym
from gymnasium.wrappers import RecordVideo

import ms_highway

ms_highway.low_latency()  # before anything is computed
ms_highway.keep_compilations()  # for the next time

config = {
    "vehicles_count": 15,
    "duration": 5,
}  # of highway-env; the robot's own settings come next
env = gym.make("highway-fast-v0", render_mode="rgb_array", config=config)
env = ms_highway.drive(env, {"budget": 20, "desired_speed": 27.0, "acceleration": 4.0})
env = RecordVideo(env, "videos", name_prefix="stock-road")
env.unwrapped.set_record_video_wrapper(env)  # for frames between the steps, too

env.reset(seed=0)
done = False
while not done:
    _, reward, terminated, truncated, info = env.step(None)  # the robot drives itself
    done = terminated or truncated
    road = info["road"]
    cars = ", ".join(
        f"{count} {model}"
        for model, count in Counter(filter(None, road["models"])).items()
    )
    print(
        f"{info['speed']:.1f} m/s, at most {road['acceleration']:.1f} m/s^2,"
        f" {road['source']}; {cars or 'nobody'}"
    )
env.close()
