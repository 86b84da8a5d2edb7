"""Learn which human model is worth its time, with DQN of stable-baselines3, and compare with Algorithm 1.

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

from ms_highway import keep_compilations, low_latency
from ms_highway.envs import SCENARIOS, environment_id
from ms_highway.experiments.runner import episode, make_environment

BESIDE = ("switching:0.1", "tom")  # controllers that the agent is compared with
LEARNER = {
    "learning_rate": 1e-3,
    "learning_starts": 400,
    "batch_size": 64,
    "gamma": 0.95,
    "target_update_interval": 250,
    "exploration_fraction": 0.5,
    "exploration_final_eps": 0.02,
    "policy_kwargs": {"net_arch": [64, 64]},
}


def choosing(scenario: str, price: float) -> gym.Env:
    """The environment in which the agent chooses the human model of each step."""
    return gym.make(environment_id(scenario), config={"action": {"type": "HumanModelAction", "lambda": price}})


def learn(scenario: str, price: float, steps: int, seed: int, settings: dict) -> DQN:
    """An agent that has learned to choose, from episodes whose starts follow from the seed."""
    agent = DQN("MlpPolicy", Monitor(choosing(scenario, price)), seed=seed, device="cpu", **settings)
    return agent.learn(steps)


def drive(agent: DQN, scenario: str, price: float, seeds: range) -> list[tuple[float, float]]:
    """The robot's reward and the seconds T(M) of every step that the agent's choices come to."""
    env, steps = choosing(scenario, price), []
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        done = False
        while not done:
            action, _ = agent.predict(observation, deterministic=True)
            observation, _, terminated, truncated, info = env.step(int(action))
            done = terminated or truncated
            earned = sum(value for name, value in info["rewards"].items() if name != "computation")
            steps.append((earned, info["counted_seconds"]))
    return steps


def main() -> None:
    """Learn, and print the table."""
    parser = argparse.ArgumentParser(description="Learn which human model is worth its time.")
    parser.add_argument("scenario", nargs="?", default="merger", help=f"{', '.join(SCENARIOS)} (default: merger)")
    parser.add_argument("--price", type=float, default=3, help="lambda, reward per second (default: 3)")
    parser.add_argument("--steps", type=int, default=5000, help="of learning (default: 5000)")
    parser.add_argument("--runs", type=int, default=1, help="agents that learn, seeded 0, 1, ... (default: 1)")
    parser.add_argument("--episodes", type=int, default=30, help="to judge by (default: 30)")
    parser.add_argument("--defaults", action="store_true", help="take stable-baselines3's own hyperparameters")
    options = parser.parse_args()
    scenario, price = options.scenario, options.price
    seeds = range(10_000, 10_000 + options.episodes)  # no agent learns from these

    outcomes = {}
    for controller in BESIDE:
        env = make_environment(scenario, controller)
        outcomes[controller] = [
            (step["reward"], step["counted_seconds"]) for seed in seeds for step in episode(env, seed)
        ]
    for run in range(options.runs):
        agent = learn(scenario, price, options.steps, run, {} if options.defaults else LEARNER)
        outcomes[f"dqn, seed {run}"] = drive(agent, scenario, price, seeds)

    print(f"{scenario}, {options.episodes} episodes, a second of planning costs {price:g}")
    print(f"{'':16}{'reward/step':>12}{'counted ms':>12}{'reward - price':>16}")
    for name, steps in outcomes.items():
        earned, seconds = np.mean(steps, axis=0)
        print(f"{name:16}{earned:12.2f}{1e3 * seconds:12.0f}{earned - price * seconds:16.2f}")


if __name__ == "__main__":
    low_latency()  # before JAX computes anything
    keep_compilations()
    main()
