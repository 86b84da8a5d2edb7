r"""Learn with PPO which human model is worth its time.

PPO is that of stable-baselines3; the result is compared with the package's choices. The
agent's action is the model of every human in the coming step: Discrete with one human,
MultiDiscrete with several. Its reward is the robot's less the price of the plan, ``r_R
- lambda T(M)``: the paper's meta-MDP. It learns in many environments at once, simulated
in JAX. The agent is saved; its file then stands for a controller, here and in every
command. Needs stable-baselines3::

    pip install stable-baselines3
    python notebooks/examples/learn_to_choose.py merger-v1
    python notebooks/examples/learn_to_choose.py merger-v1 --price 10 \
      --set costs=published
    python notebooks/examples/learn_to_choose.py dense_merge --set humans=3 \
      --steps 10000
    ms-highway compare merger-v1 --controllers results/ppo.zip learned:1 tom \
      --out results/ppo

Prints a row for the agent and every other choice, from starts that the agent has not
seen: reward per step, the same less lambda T, share of steps planned with each model,
and by how much the agent is ahead, with a 90 % interval. ``--steps 0`` judges an agent
that was saved before.
"""

import argparse
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize

import ms_highway
from ms_highway.cli.options import configuration
from ms_highway.envs import environment_id
from ms_highway.experiments.batch import simulated
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.runner import make_environment
from ms_highway.experiments.summary import interval

SETTINGS = {
    "batch_size": 640,
    "gamma": 0.97,
    "learning_rate": 1e-3,
    "ent_coef": 0.01,
}


class ManyEnvironments(VecEnv):
    """A vector environment of Gymnasium, which resets in the step of an end, as
    stable-baselines3 wants it.
    """

    def __init__(self, envs):
        self.envs = envs
        super().__init__(
            envs.num_envs, envs.single_observation_space, envs.single_action_space
        )

    def reset(self):
        observations, _ = self.envs.reset(seed=0)
        return observations.copy()

    def step_async(self, actions):
        self.actions = actions

    def step_wait(self):
        observations, rewards, terminated, truncated, info = self.envs.step(
            self.actions
        )
        ends = terminated | truncated
        infos = [{} for _ in ends]
        # After the last step of an episode nothing is paid, so the value of later steps
        # is 0.
        for place in np.flatnonzero(ends):
            infos[place]["terminal_observation"] = info["final_obs"][place]
        return observations.copy(), rewards.astype(np.float32), ends, infos

    def close(self):
        self.envs.close()

    def get_attr(self, attr_name, indices=None):
        return [getattr(self.envs, attr_name, None) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name, value, indices=None):
        raise NotImplementedError(f"{attr_name} belongs to all environments together")

    def env_method(self, method_name, *args, indices=None, **kwargs):
        raise NotImplementedError(f"{method_name} belongs to all environments together")

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False for _ in self._get_indices(indices)]


def make_environments(options, config, number):
    """Make environments in which an agent chooses models, and pays for them."""
    action = {"type": "HumanModelAction", "lambda": options.price}
    name = environment_id(options.scenario)
    return gym.make_vec(
        name, number, config=config | {"action": action}, autoreset_mode="SameStep"
    )


def learn(options, config):
    """Train an agent, and save it."""
    torch.set_num_threads(1)  # such networks are small
    envs = make_environments(options, config, options.environments)
    # Rewards are divided by their deviation, so that values are about 1.
    many = VecNormalize(VecMonitor(ManyEnvironments(envs)), norm_obs=False)
    steps = envs.unwrapped.episode_steps
    agent = PPO(
        "MlpPolicy",
        many,
        seed=options.seed,
        n_steps=steps,
        device="cpu",
        verbose=1,
        **SETTINGS,
    )
    agent.learn(options.steps)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    agent.save(options.out)
    many.close()


def drive(envs, choose, options):
    """Return a row per step of an episode in every environment, where a function of
    observations chooses models.
    """
    observations, _ = envs.reset(seed=options.first_seed)
    steps = []
    for _ in range(envs.unwrapped.episode_steps):
        observations, rewards, _, _, info = envs.step(choose(observations))
        paid = options.price * info["counted_seconds"]
        row = {
            "reward": rewards + paid,
            "counted_seconds": info["counted_seconds"],
            "model": info["model"],
        }
        steps.append(
            pd.DataFrame(row).assign(seed=options.first_seed + np.arange(envs.num_envs))
        )
    return pd.concat(steps)


def all_driven(options, config):
    """Return a row per step by controller: the agent, random choice, every model
    throughout, and learned values.
    """
    envs = make_environments(options, config, options.episodes)
    envs.action_space.seed(options.first_seed)
    agent = PPO.load(options.out, device="cpu")
    rungs = make_environment(
        options.scenario, "naive", **config
    ).unwrapped.settings.models
    driven = {
        "agent": drive(
            envs, lambda seen: agent.predict(seen, deterministic=True)[0], options
        ),
        "random": drive(envs, lambda _: envs.action_space.sample(), options),
    }
    for place, rung in enumerate(rungs):
        always = np.full(envs.action_space.shape, place)
        driven[rung.name] = drive(envs, lambda _, always=always: always, options)
    learned = f"learned:{options.price:g}"
    asked = Comparison(
        {options.scenario: [learned]}, options.episodes, options.first_seed, config
    )
    return driven | {learned: simulated(asked)}


def compared(driven, price):
    """Return a table: what every controller earns, and by how much the agent is ahead,
    over the same starts.
    """
    models = list(
        dict.fromkeys(
            name for steps in driven.values() for name in steps["model"].unique()
        )
    )
    models = [name for name in driven if name in models]  # cheapest first
    net = {}
    rows = []
    for name, steps in driven.items():
        means = steps.groupby("seed")[["reward", "counted_seconds"]].mean()
        net[name] = means["reward"] - price * means["counted_seconds"]
        ahead = net["agent"] - net[name]
        low, high = interval(ahead)
        shares = (
            steps["model"].value_counts(normalize=True).reindex(models, fill_value=0.0)
        )
        row = {"controller": name, "reward": f"{means['reward'].mean():.2f}"}
        row["less lambda T"] = f"{net[name].mean():.2f}"
        row[f"{' / '.join(models)} %"] = " / ".join(
            f"{100 * share:.0f}" for share in shares
        )
        row["agent ahead by"] = (
            "" if name == "agent" else f"{ahead.mean():.2f} ({low:.2f}, {high:.2f})"
        )
        rows.append(row)
    return pd.DataFrame(rows)


def main() -> None:
    """Train an agent, and compare it with other choices."""
    parser = argparse.ArgumentParser(
        description="Learn which human model is worth its time."
    )
    parser.add_argument("scenario", nargs="?", default="merger-v1")
    parser.add_argument(
        "--price",
        type=float,
        default=1.0,
        help="lambda, reward per second (default: 1)",
    )
    parser.add_argument(
        "--steps", type=int, default=300_000, help="of learning (default: 300,000)"
    )
    parser.add_argument(
        "--environments", type=int, default=64, help="to learn in at once (default: 64)"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="of the training (default: 0)"
    )
    parser.add_argument(
        "--episodes", type=int, default=100, help="to judge by (default: 100)"
    )
    parser.add_argument(
        "--first-seed", type=int, default=5000, help="of these episodes (default: 5000)"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("results/ppo.zip"), help="file of the agent"
    )
    parser.add_argument(
        "--set", dest="keys", action="append", default=[], metavar="KEY=VALUE"
    )
    options = parser.parse_args()
    config = configuration(options)
    if options.steps:
        learn(options, config)
    print(
        f"a second costs {options.price:g}; means per step of {options.episodes}"
        " episodes"
    )
    print(compared(all_driven(options, config), options.price).to_string(index=False))


if __name__ == "__main__":
    ms_highway.keep_compilations()  # before JAX computes anything
    main()
