"""Record a robot in a stock scene as a data set of Minari, and clone it.

The clone is a network. ``info["road"]["action"]`` is the action of the environment's
space that does what the robot did, NaN where none does (here are none); the action
given to ``step`` is ignored. Needs the extras ``demonstrations`` and ``learning``.
Run::

    python notebooks/examples/imitate.py
"""

import os

import gymnasium as gym
import jax
import numpy as np
import optax

import ms_highway

os.environ.setdefault("MINARI_DATASETS_PATH", os.path.abspath("datasets"))
import minari  # which reads it

NAME, EPISODES, HELD_OUT, SEEN = (
    "highway-fast/robot-v0",
    6,
    2,
    25,
)  # of the data set; numbers of an observation
CONFIG = {"lanes_count": 1, "vehicles_count": 4, "duration": 10, "policy_frequency": 5}
CONFIG["action"] = {"type": "ContinuousAction"}


class Done(minari.StepDataCallback):
    def __call__(self, env, *, info, action=None, **step):
        return super().__call__(env, info=info, action=info["road"]["action"], **step)


def act(layers, seen):
    return (
        jax.numpy.tanh(seen @ layers[0][0] + layers[0][1]) @ layers[1][0] + layers[1][1]
    )


if __name__ == "__main__":
    if NAME not in minari.list_local_datasets():
        robot = ms_highway.drive(
            gym.make("highway-fast-v0", config=CONFIG), {"driver": "fixed:idm"}
        )
        collector = minari.DataCollector(robot, step_data_callback=Done)
        for seed in range(EPISODES):
            collector.reset(seed=seed)
            while not any(collector.step(collector.action_space.sample())[2:4]):
                pass
        collector.create_dataset(NAME, algorithm_name="ms_highway, fixed:idm")
    data = [
        (each.observations[:-1].reshape(-1, SEEN), each.actions)
        for each in minari.load_dataset(NAME)
    ]
    seen, done = map(np.concatenate, zip(*data[:-HELD_OUT], strict=True))
    new, truth = map(np.concatenate, zip(*data[-HELD_OUT:], strict=True))
    random = np.random.default_rng(0)
    optimizer = optax.adam(3e-3)
    layers = [
        (random.normal(size=(n, m)) / n**0.5, np.zeros(m))
        for n, m in ((SEEN, 32), (32, 2))
    ]
    state = optimizer.init(layers)
    slope = jax.jit(
        jax.grad(lambda layers: jax.numpy.mean((act(layers, seen) - done) ** 2))
    )
    for _ in range(300):
        change, state = optimizer.update(slope(layers), state)
        layers = optax.apply_updates(layers, change)
    clone, mean = (
        float(np.sqrt(np.mean((each - truth) ** 2)))
        for each in (act(layers, new), done.mean(axis=0))
    )
    print(
        f"off by {clone:.2f} in episodes that it has not seen; the mean action by"
        f" {mean:.2f}"
    )
    env = gym.make("highway-fast-v0", config=CONFIG)
    ends = [False]
    observation, _ = env.reset(seed=100)
    while not any(ends):
        observation, _, *ends, info = env.step(
            np.clip(act(layers, observation.reshape(SEEN)), -1, 1)
        )
    print(
        f"drove {env.unwrapped.time:.0f} s by itself at last at {info['speed']:.1f}"
        f" m/s, crashed: {info['crashed']}"
    )
