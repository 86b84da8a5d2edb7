"""Drive episodes of a stock scene, measure them, film them and summarise them."""

import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from itertools import count
from pathlib import Path
from queue import Queue
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import pandas as pd
from highway_env.envs.common.abstract import AbstractEnv

from ms_highway.benchmarks.road import (
    INTENTIONS,
    RECORDED,
    TRAFFIC,
    driver_config,
)
from ms_highway.benchmarks.road.export import Drive
from ms_highway.benchmarks.road.measures import Watch
from ms_highway.benchmarks.road.peers import (
    Agent,
    Commuter,
    Human,
    Idm,
    Peer,
    RecordedStart,
)
from ms_highway.envs.agents import AGENTS, is_agent, policy_of
from ms_highway.road import drive
from ms_highway.road.graphics import show
from ms_highway.road.settings import DRIVER_VALUES, RoadSettings
from ms_highway.road.stock import success
from ms_highway.runtime.files import file_name
from ms_highway.runtime.jax_settings import cores, low_latency_on_core, own_process

PEERS: dict[str, type[Peer]] = {"idm": Idm, "commuter": Commuter, "human": Human}
"""Drivers from outside this package, by name."""


class Block(NamedTuple):
    """Episodes of one driver in one scene.

    Attributes:
        scene: identifier of a stock environment, or
            `ms_highway.benchmarks.road.RECORDED`.
        driver: name of the driver.
        traffic: a name of `ms_highway.benchmarks.road.TRAFFIC`, or of
            ``RECORDED_TRAFFIC``.
        starts: in recordings; seeds are their indices.
        exports: directory for drives in recordings, None to write none.
    """

    scene: str
    driver: str
    traffic: str = "idm"
    starts: tuple[RecordedStart, ...] = ()
    exports: Path | None = None

    def name(self, seed: int) -> str:
        """Return the name of a start, for logs."""
        return self.starts[seed].name if self.starts else str(seed)


def check_driver(name: str) -> None:
    """Refuse an unknown driver.

    Raises:
        ModuleNotFoundError: for an agent, without stable-baselines3.
        ValueError: for an unknown driver; it names the known ones.
    """
    if is_agent(name):
        policy_of(name)
    elif name not in PEERS:
        try:
            RoadSettings.read(driver_config(name))
        except ValueError as error:
            others = (
                f"DRIVER[{INTENTIONS}]",
                "AGENT.zip",
                "a name of add_driver or add_agent",
            )
            known = ", ".join([*PEERS, *DRIVER_VALUES, *others])
            raise ValueError(
                f"unknown driver {name!r}; the drivers are {known} ({error})"
            ) from None


def make_driver(block: Block, render_mode: str | None = None) -> gym.Env:
    """Make an environment with its driver; its ``step`` ignores the action.

    Args:
        block: scene, driver and traffic.
        render_mode: of the environment.
    """
    scene = block.scene
    config = {"other_vehicles_type": TRAFFIC.get(block.traffic)}
    if scene == RECORDED:
        scene = "ms_highway:ms-highway/recorded-v0"
        config = {"traffic": block.traffic, **block.starts[0].config}
    if block.driver in AGENTS:
        config |= AGENTS[block.driver].config
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*is out of date", DeprecationWarning)
        env = gym.make(
            scene, config=config, disable_env_checker=True, render_mode=render_mode
        )
    if is_agent(block.driver):
        return Agent(env, block.driver)
    if block.driver in PEERS:
        return PEERS[block.driver](env)
    return drive(env, driver_config(block.driver))


_kept_driver = cache(make_driver)


def run_episode(
    block: Block,
    seed: int,
    env: gym.Env | None = None,
    then: Callable[[], None] | None = None,
) -> dict:
    """Drive one episode.

    Success means: no crash, and the goal is reached at the end, see
    `ms_highway.road.stock.success`; in scenes without a goal, no crash, and the ego
    stayed on the road in all frames.

    Args:
        block: scene, driver and traffic.
        seed: of the start.
        env: environment made by `make_driver` for the block; by default, one that this
            process keeps.
        then: function to call after every frame.

    Returns:
        * ``seed``; ``success``; ``crashed``; ``at_fault``, whether the ego crashed by
          its own fault; ``off_road``, whether it left the road;
        * ``steps``, the number of the environment's steps; ``reward``, its sum over
          them;
        * figures of the motion until the end or a crash, see
          `ms_highway.benchmarks.road.measures.motion_figures`;
        * figures of the other vehicles, see
          `ms_highway.benchmarks.road.measures.OthersWatch.figures`;
        * ``late``, the number of plans that were not ready within their budget;
        * ``decisions``, the duration of each decision, without compilation [s];
          ``sources``, the number of decisions by what drove, if the driver tells;
          ``rungs``, how many cars each rung predicted, summed over decisions.
    """
    env = env or _kept_driver(block)
    options = {"config": block.starts[seed].config} if block.starts else None
    env.reset(seed=seed, options=options)
    inner: AbstractEnv = env.unwrapped

    # What is called after every frame.
    calls = [] if then is None else [then]
    exported = Drive(inner) if block.exports else None
    if exported:
        calls.append(exported.see)
    watch = Watch(inner, *calls)

    # Scenes without a time limit get one of a minute.
    longest = max(60.0, inner.config.get("duration", 0.0))
    rewards = []
    roads = []
    done = False
    while not done:
        _, reward, terminated, truncated, info = env.step(None)
        rewards.append(float(reward))
        roads.append(info["road"])
        done = terminated or truncated or inner.time >= longest

    # An episode may end because the ego has left the road in its last frame.
    left_at_end = terminated and not watch.crashed and not inner.vehicle.on_road
    if block.scene == RECORDED:
        off_road = inner.off_road
    else:
        off_road = bool(watch.off_road or left_at_end)
    reached = success(inner)
    if reached is None:
        reached = not off_road

    if exported and block.exports:
        directory = block.exports / block.traffic / file_name(block.driver)
        exported.write(directory, file_name(block.name(seed)))
    return {
        "seed": seed,
        "success": not watch.crashed and bool(reached),
        "crashed": watch.crashed,
        "at_fault": watch.at_fault,
        "off_road": off_road,
        "steps": len(rewards),
        "reward": sum(rewards),
        **watch.motion(),
        **watch.others.figures(),
        **_of_decisions(roads),
    }


def _of_decisions(roads: Sequence[Mapping]) -> dict:
    """Return the figures of the decisions of an episode, see `run_episode`.

    Args:
        roads: ``info["road"]`` of every step.
    """
    decisions: list[float] = []
    sources = Counter[str]()
    rungs = Counter[str]()
    late = 0
    for road in roads:
        # The time of a plan that was not made is NaN.
        decisions += [seconds for seconds in road["decisions"] if seconds >= 0]
        sources.update(source for source in road.get("sources", ()) if source)
        rungs += Counter(road.get("model_counts", {}))
        late += road.get("late", 0)
    return {"decisions": decisions, "late": late, "sources": sources, "rungs": rungs}


def run_blocks(
    blocks: Sequence[Block],
    seeds: Sequence[int],
    films: Path | None = None,
    modules: Sequence[str] = (),
) -> Iterator[tuple[Block, list[dict]]]:
    """Drive the same starts in all blocks; yield each block with its episodes.

    They are in the order of blocks and seeds. Each block has its own process on one
    core, because some scenes permanently change the class of other vehicles.

    Args:
        blocks: scenes, drivers and traffic.
        seeds: of the starts.
        films: directory for films of the first failure and the first success of each
            block.
        modules: to import in the processes.

    Raises:
        ValueError: if a driver cannot be made.
    """
    free = Queue[int]()
    for core in range(cores()):
        free.put(core)

    def drive(block: Block) -> tuple[Block, list[dict]]:
        core = free.get()
        try:
            with own_process(partial(low_latency_on_core, core), modules) as process:
                return block, process.submit(_run_block, block, seeds, films).result()
        finally:
            free.put(core)

    with ThreadPoolExecutor(cores()) as threads:
        yield from threads.map(drive, blocks)


def _run_block(block: Block, seeds: Sequence[int], films: Path | None) -> list[dict]:
    """Drive the episodes of a block; film the first success and the first failure."""
    episodes = [run_episode(block, seed) for seed in seeds]
    if films is not None:
        # Of several episodes, the first one remains.
        firsts = {episode["success"]: episode["seed"] for episode in reversed(episodes)}
        for succeeds, seed in firsts.items():
            outcome = "success" if succeeds else "failure"
            name = f"{block.scene}_{block.driver}_{outcome}_{block.name(seed)}"
            film(block, seed, films / f"{file_name(name)}.gif")
    return episodes


def film(block: Block, seed: int, path: Path) -> None:
    """Drive an episode again and write it to a video file, ``.gif`` or ``.mp4``.

    It plays at real speed.

    Raises:
        OSError: if it cannot be written.
    """
    from ms_highway.visualization.video import scaled, write

    # A small file, as web pages load it.
    most_pictures_per_second = 10
    largest_height = 360

    env = make_driver(block, render_mode="rgb_array")
    inner: AbstractEnv = env.unwrapped
    frequency = inner.config["simulation_frequency"]
    pictures: list[np.ndarray] = []
    frames = count()
    every = max(1, round(frequency / most_pictures_per_second))

    def take_picture() -> None:
        if next(frames) % every == 0:
            picture = env.render()
            assert isinstance(picture, np.ndarray)
            pictures.append(picture)

    show(env)
    run_episode(block._replace(exports=None), seed, env, take_picture)
    env.close()
    height, width = pictures[0].shape[:2]
    film_width = width * min(largest_height, height) // height
    write(scaled(pictures, film_width), path, frequency / every)


def summary(block: Block, episodes: Sequence[Mapping]) -> dict:
    """Return the figures of a driver in a scene, for JSON.

    * ``success``, ``off_road``: shares of the episodes in which the goal was reached,
      and the road was left;
    * ``collisions``, ``at_fault``: numbers of episodes in which the ego crashed, and
      was at fault;
    * ``reward_per_step``, ``return``: mean reward over all steps of all episodes, and
      mean sum of an episode;
    * ``mean_speed``: over all frames [m/s]; ``stood``: mean time below 1 m/s in an
      episode [s];
    * ``max_acceleration``, ``max_acceleration_of_centre``: the largest of all episodes
      [m/s^2];
    * ``jerk``: root mean square over all frames [m/s^3];
    * ``p50_ms``, ``p99_ms``: quantiles of the durations of all decisions [ms];
    * ``late``: share of the plans that were not ready within their budget;
    * ``steps``: mean number per episode; ``goal_seconds``: mean duration of the
      successful episodes, None without any [s];
    * ``sources``: shares of the decisions by what drove, if the driver tells;
    * ``rungs``: shares of the cars that each rung predicted;
    * ``any_collisions``, ``others_collisions``: numbers of episodes in which any
      vehicles collided, and in which other vehicles collided without the ego;
    * ``others_speed``, ``others_arrived``: their mean speed [m/s], and how many of them
      arrive in an episode;
    * ``others_braking``: their hardest braking in any frame [m/s^2];
    * ``episodes``: their number; ``seeds``: the first seed and how many; ``traffic``:
      type of the other vehicles; ``label``: ``unphysical`` if ``max_acceleration``
      exceeds the grip of tyres, 10 m/s^2.
    """
    of = pd.DataFrame(episodes)
    p50, p99 = np.quantile(np.concatenate(of["decisions"]), [0.5, 0.99])
    largest = of["max_acceleration"].max()
    unphysical = largest > 10.0
    seconds_to_goal = of["seconds"][of["success"]]
    figures = {
        **of[["success", "off_road", "stood", "steps"]].mean(),
        "collisions": of["crashed"].sum(),
        "at_fault": of["at_fault"].sum(),
        "reward_per_step": of["reward"].sum() / of["steps"].sum(),
        "return": of["reward"].mean(),
        "mean_speed": of["distance"].sum() / of["seconds"].sum(),
        "max_acceleration": largest,
        "max_acceleration_of_centre": of["max_acceleration_of_centre"].max(),
        "jerk": np.sqrt(np.average(of["squared_jerk"], weights=of["frames"])),
        "p50_ms": 1e3 * p50,
        "p99_ms": 1e3 * p99,
        "late": of["late"].sum() / of["decisions"].map(len).sum(),
        "goal_seconds": None if seconds_to_goal.empty else seconds_to_goal.mean(),
        "any_collisions": of["collided"].sum(),
        "others_collisions": of["others_collided"].sum(),
        "others_speed": of["others_speed"].mean(),
        "others_arrived": of["others_arrived"].mean(),
        "others_braking": of["others_braking"].max(),
        "sources": _shares(of["sources"]),
        "rungs": _shares(of["rungs"]),
        "episodes": len(episodes),
        "seeds": [episodes[0]["seed"], len(episodes)],
        "traffic": block.traffic,
        "label": "unphysical" if unphysical else "",
    }
    # JSON has no numbers of NumPy.
    return {
        name: figure.item() if isinstance(figure, np.generic) else figure
        for name, figure in figures.items()
    }


def _shares(counters: pd.Series) -> dict[str, float]:
    """Return the share of each name in the sum of counters."""
    counts = sum(counters, Counter[str]())
    return {name: number / counts.total() for name, number in counts.items()}


def row(block: Block, episode: Mapping) -> dict:
    """Return an episode as a row of a table."""
    cells: dict = {
        "scene": block.scene,
        "driver": block.driver,
        "traffic": block.traffic,
    }
    if block.starts:
        cells["start"] = block.name(episode["seed"])
    for name, value in episode.items():
        if name not in ("decisions", "sources", "rungs"):
            cells[name] = value
    times = 1e3 * np.array(episode["decisions"])
    cells["p50_ms"] = float(np.median(times))
    cells["max_ms"] = float(times.max())
    return cells
