"""Learn which human model is worth its time, with PPO of stable-baselines3, and compare with the package's choices.

The agent's action is the model of every human in the coming step: Discrete with one human, MultiDiscrete with several.
Its reward is the robot's less the price of the plan, ``r_R - lambda T(M)``: the paper's meta-MDP. The agent is saved;
its file then stands for a controller, here and in every command. Needs stable-baselines3::

    pip install stable-baselines3
    python notebooks/examples/learn_to_choose.py merger-v1
    python notebooks/examples/learn_to_choose.py dense_merge --set humans=3 --steps 10000
    ms-highway compare merger-v1 --controllers results/ppo.zip learned:1 tom --out results/ppo
"""

import argparse
from pathlib import Path

import gymnasium as gym
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import ms_highway
from ms_highway.cli.options import configuration
from ms_highway.envs import environment_id
from ms_highway.experiments.runner import episode, make_environment

SETTINGS = {"n_steps": 800, "batch_size": 200, "gamma": 0.97, "learning_rate": 1e-3}

if __name__ == "__main__":
    ms_highway.low_latency()  # before JAX computes anything
    ms_highway.keep_compilations()
    parser = argparse.ArgumentParser(description="Learn which human model is worth its time.")
    parser.add_argument("scenario", nargs="?", default="merger-v1")
    parser.add_argument("--price", type=float, default=1.0, help="lambda, reward per second (default: 1)")
    parser.add_argument("--steps", type=int, default=8_000, help="of learning (default: 8,000)")
    parser.add_argument("--episodes", type=int, default=30, help="to judge by (default: 30)")
    parser.add_argument("--out", type=Path, default=Path("results/ppo.zip"), help="file of the agent")
    parser.add_argument("--set", dest="keys", action="append", default=[], metavar="KEY=VALUE")
    options = parser.parse_args()
    config = configuration(options)
    action = {"type": "HumanModelAction", "lambda": options.price}
    env = gym.make(environment_id(options.scenario), config=config | {"action": action})
    alone = VecNormalize(DummyVecEnv([lambda: Monitor(env)]), norm_obs=False)  # rewards, so that values are about 1
    agent = PPO("MlpPolicy", alone, seed=0, device="cpu", verbose=1, **SETTINGS).learn(options.steps)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    agent.save(options.out)
    rungs = [model.name for model in env.unwrapped.settings.models]
    random = "random:" + ",".join(f"{name}={1 / len(rungs):.12g}" for name in rungs)
    print(f"a second costs {options.price:g}: reward per step less that")
    for name in (str(options.out), random, "naive", f"learned:{options.price:g}"):
        beside = make_environment(options.scenario, name, **config)
        steps = [step for seed in range(10_000, 10_000 + options.episodes) for step in episode(beside, seed)]
        earned = sum(step["reward"] - options.price * step["counted_seconds"] for step in steps) / len(steps)
        print(f"{name.partition(':')[0]:20}{earned:8.3f}")
