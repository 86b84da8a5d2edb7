r"""Train agents of stable-baselines3 in stock scenes of highway-env.

They are drivers for ``ms-highway bench road``. DQN and PPO have the settings of
highway-env's own examples, which train for 20,000 steps; actions and observations are
each environment's own. Writes ``agents/ALGORITHM-SCENE-SEED.zip``. Needs
stable-baselines3::

    pip install stable-baselines3
    python notebooks/examples/train_peers.py intersection-v0 --steps 100000 \
      --seeds 0 1 2
    ms-highway bench road intersection-v0 \
      --drivers priced agents/dqn-intersection-v0-0.zip
"""

import argparse
from pathlib import Path

import highway_env  # noqa: F401
import torch
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.env_util import make_vec_env

SCENES = ("highway-fast-v0", "merge-v0", "intersection-v0", "roundabout-v0")
COMMON = {"learning_rate": 5e-4, "gamma": 0.8}
BUFFER = {
    "buffer_size": 15_000,
    "learning_starts": 200,
    "train_freq": 1,
    "target_update_interval": 50,
}
AGENTS = {  # class, number of environments, hyperparameters
    "dqn": (
        DQN,
        1,
        COMMON | BUFFER | {"batch_size": 32, "policy_kwargs": {"net_arch": [256, 256]}},
    ),
    "ppo": (
        PPO,
        6,
        COMMON
        | {
            "n_steps": 128,
            "batch_size": 64,
            "policy_kwargs": {"net_arch": [256, 256]},
        },
    ),
}


def main() -> None:
    """Train each algorithm in each scene with each seed, and save the agents."""
    parser = argparse.ArgumentParser(
        description="Train peers for ms-highway bench road."
    )
    parser.add_argument(
        "scenes",
        nargs="*",
        default=SCENES,
        help=f"environments (default: {' '.join(SCENES)})",
    )
    parser.add_argument(
        "--algorithms",
        nargs="+",
        choices=AGENTS,
        default=list(AGENTS),
        help="default: all",
    )
    parser.add_argument(
        "--steps", type=int, default=20_000, help="of each agent (default: 20000)"
    )
    parser.add_argument(
        "--seeds",
        nargs="+",
        type=int,
        default=[0],
        help="of the trainings (default: 0)",
    )
    parser.add_argument(
        "--to", type=Path, default=Path("agents"), help="directory (default: agents)"
    )
    options = parser.parse_args()
    torch.set_num_threads(1)  # such networks are small
    for seed in options.seeds:
        for scene in options.scenes:
            for algorithm in options.algorithms:
                kind, copies, settings = AGENTS[algorithm]
                environments = make_vec_env(scene, copies, seed=seed)
                agent = kind(
                    "MlpPolicy", environments, seed=seed, device="cpu", **settings
                )
                agent.learn(options.steps)
                file = options.to / f"{algorithm}-{scene}-{seed}.zip"
                file.parent.mkdir(parents=True, exist_ok=True)
                agent.save(file)
                environments.close()
                print(file, flush=True)


if __name__ == "__main__":
    main()
