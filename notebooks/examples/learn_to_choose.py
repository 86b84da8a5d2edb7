"""Learn which human model is worth its time, with DQN of stable-baselines3, and compare with the package's choices.

The agent's action is the human model that the coming step is planned with; its reward is the robot's less the price of
the plan, ``r_R - lambda T(M)``: the paper's meta-MDP. Needs stable-baselines3::

    pip install stable-baselines3
    python notebooks/examples/learn_to_choose.py merger --price 3
"""

import argparse

import gymnasium as gym
import numpy as np
from stable_baselines3 import DQN
from stable_baselines3.common.monitor import Monitor

import ms_highway
from ms_highway.experiments.runner import episode, make_environment

SETTINGS = {"learning_rate": 1e-3, "learning_starts": 400, "batch_size": 64, "gamma": 0.95, "exploration_fraction": 0.5}
SETTINGS |= {"target_update_interval": 250, "exploration_final_eps": 0.02, "policy_kwargs": {"net_arch": [64, 64]}}


def drive(agent, env, seed):
    """Return reward and T(M) of every step of an episode for which the agent chooses."""
    (observation, _), steps, ends = env.reset(seed=seed), [], [False]
    while not any(ends):
        action, _ = agent.predict(observation, deterministic=True)
        observation, _, *ends, info = env.step(int(action))
        earned = sum(value for name, value in info["rewards"].items() if name != "computation")
        steps.append((earned, info["counted_seconds"]))
    return steps


if __name__ == "__main__":
    ms_highway.low_latency()  # before JAX computes anything
    ms_highway.keep_compilations()
    parser = argparse.ArgumentParser(description="Learn which human model is worth its time.")
    parser.add_argument("scenario", nargs="?", default="merger", help="merger (default), give_way, stay_back")
    parser.add_argument("--price", type=float, default=3, help="lambda, reward per second (default: 3)")
    parser.add_argument("--steps", type=int, default=5000, help="of learning (default: 5000)")
    parser.add_argument("--episodes", type=int, default=30, help="to judge by (default: 30)")
    parser.add_argument("--defaults", action="store_true", help="take stable-baselines3's own hyperparameters")
    options = parser.parse_args()
    seeds = range(10_000, 10_000 + options.episodes)  # the agent does not learn from these
    action = {"type": "HumanModelAction", "lambda": options.price}
    env = gym.make(f"ms-highway/{options.scenario.replace('_', '-')}-v0", config={"action": action})
    settings = {} if options.defaults else SETTINGS
    agent = DQN("MlpPolicy", Monitor(env), seed=0, device="cpu", **settings).learn(options.steps)
    outcomes = {"dqn": [step for seed in seeds for step in drive(agent, env, seed)]}
    for name in (f"learned:{options.price:g}", "switching:0.1", "tom"):  # at 0.1, switching does best in Merger
        beside = make_environment(options.scenario, name)
        steps = (step for seed in seeds for step in episode(beside, seed))
        outcomes[name] = [(step["reward"], step["counted_seconds"]) for step in steps]
    print(f"{'a second costs ' + format(options.price, 'g'):20}{'reward/step':>12}{'counted ms':>12}{'less price':>12}")
    for name, steps in outcomes.items():
        earned, seconds = np.mean(steps, axis=0)
        print(f"{name:20}{earned:12.2f}{1e3 * seconds:12.0f}{earned - options.price * seconds:12.2f}")
