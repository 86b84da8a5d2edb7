"""Drive one episode of a stock scene and measure it."""

import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym

from ms_highway.benchmarks.road.goals import LONGEST, is_reached
from ms_highway.benchmarks.road.measures import Motion, Watch
from ms_highway.benchmarks.road.names import PEERS

__all__ = ["TRAFFIC", "Block", "Episode", "make_driver", "run_episode"]

TRAFFIC = {
    "idm": "highway_env.vehicle.behavior.IDMVehicle",
    "commuter": "ms_highway.vehicle.CommuterVehicle",
    "unyielding": "ms_highway.benchmarks.road.unyielding.UnyieldingVehicle",
}
"""Types of other vehicles, by name."""


@dataclass(frozen=True)
class Block:
    """Episodes that belong together.

    Attributes:
        scene: identifier of a stock environment.
        driver: name of what drives the ego.
        traffic: a name of `TRAFFIC`.
        dqn_steps: number of steps for which DQN is trained.
        models: directory of trained agents.
    """

    scene: str
    driver: str
    traffic: str = "idm"
    dqn_steps: int = 20_000
    models: Path = Path("results") / "dqn"


@dataclass(frozen=True)
class Episode:
    """What happened in an episode.

    Attributes:
        seed: of the start.
        success: see `ms_highway.benchmarks.road.goals.is_reached`.
        crashed: whether the ego has crashed.
        at_fault: whether it has, and is at fault.
        off_road: whether it has left the road.
        steps: of the environment.
        reward: the sum over all steps.
        motion: of the ego in every frame.
        decisions: duration of each decision, without compilation [s].
        sources: number of decisions by what drove then, where the driver says so.
        rungs: number of cars that each rung predicted, summed over decisions.
    """

    seed: int
    success: bool
    crashed: bool
    at_fault: bool
    off_road: bool
    steps: int
    reward: float
    motion: Motion
    decisions: tuple[float, ...]
    sources: Counter[str] = field(default_factory=Counter)
    rungs: Counter[str] = field(default_factory=Counter)


def make_driver(block: Block, **options: Any) -> gym.Env:
    """Make an environment that drives itself: its ``step`` ignores the action.

    Args:
        block: says what drives where.
        options: of ``gym.make``.

    Raises:
        ImportError: for DQN without stable-baselines3.
    """
    from ms_highway.benchmarks.road.dqn import Dqn
    from ms_highway.benchmarks.road.peers import Idle, Idm, Random

    config = {"other_vehicles_type": TRAFFIC[block.traffic]}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*is out of date", DeprecationWarning)
        env = gym.make(block.scene, config=config, disable_env_checker=True, **options)
    if block.driver not in PEERS:
        from ms_highway.envs.road.driven import drive

        name = block.driver.removesuffix("+belief")
        driver = name.removesuffix("+traits")
        return drive(env, {"driver": driver, "traits": driver != name, "belief": name != block.driver})
    if block.driver == "dqn":
        return Dqn(env, block.dqn_steps, block.models)
    return {"idm": Idm, "idle": Idle, "random": Random}[block.driver](env)


@cache
def _driver(block: Block) -> gym.Env:
    return make_driver(block)


def run_episode(block: Block, seed: int, env: gym.Env | None = None, then: Callable[[], None] | None = None) -> Episode:
    """Drive one episode.

    Args:
        block: says what drives where.
        seed: of the start.
        env: what `make_driver` returned for the block; by default, one that this process keeps.
        then: is called after every frame.
    """
    env = _driver(block) if env is None else env
    env.reset(seed=seed)
    inner: Any = env.unwrapped
    watch = Watch(inner, then)
    rewards, decisions, done = [], [], False
    sources, rungs = Counter[str](), Counter[str]()
    while not done:
        _, reward, terminated, truncated, info = env.step(None)
        rewards.append(float(reward))
        decisions += info["road"]["decisions"]
        sources.update(info["road"].get("sources", ()))
        rungs.update(info["road"].get("rung_counts", ()))
        done = terminated or truncated or inner.time >= max(LONGEST, inner.config.get("duration", 0.0))
    off_road = watch.off_road or (terminated and not watch.crashed and not inner.vehicle.on_road)
    return Episode(
        seed=seed,
        success=is_reached(inner, watch.crashed, off_road),
        crashed=watch.crashed,
        at_fault=watch.at_fault,
        off_road=bool(off_road),
        steps=len(rewards),
        reward=sum(rewards),
        motion=watch.motion(),
        decisions=tuple(decisions),
        sources=sources,
        rungs=rungs,
    )
