"""Drive episodes of a stock scene, measure them, film them and summarise them."""

import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pandas as pd

from ms_highway.benchmarks.road import HUMAN, INTENTIONS, RECORDED, RECORDED_ID, TRAFFIC, driver_config, is_agent
from ms_highway.benchmarks.road.export import Drive
from ms_highway.benchmarks.road.measures import Watch
from ms_highway.benchmarks.road.peers import Agent, Idle, Idm, Peer, Random, policy_of
from ms_highway.benchmarks.road.recorded import Human, RecordedStart
from ms_highway.road import drive
from ms_highway.road.graphics import show
from ms_highway.road.settings import DRIVERS, RoadSettings
from ms_highway.road.stock import success
from ms_highway.runtime import retired

UNPHYSICAL = 10.0
"""Acceleration [m/s^2] that no tyres hold."""

LONGEST = 60.0  # s, after which an episode ends in scenes that have no end of their own: a car may stand still
FRAMES_PER_SECOND = 10  # of films, at most
HIGHEST = 360  # px, of films: pages load them

OTHERS: dict[str, type[Peer]] = {"idm": Idm, "idle": Idle, "random": Random, HUMAN: Human}
"""Wrappers of the drivers that are not this package's own, by name."""


class Block(NamedTuple):
    """Episodes that belong together.

    Attributes:
        scene: identifier of a stock environment, or `ms_highway.benchmarks.road.RECORDED`.
        driver: name of what drives the ego.
        traffic: a name of `ms_highway.benchmarks.road.TRAFFIC`, or of ``RECORDED_TRAFFIC``.
        starts: in recordings, of which the seeds are numbers.
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


@dataclass(frozen=True)
class Episode:
    """What happened in an episode, and how the ego moved until its end, or until it crashed.

    Attributes:
        seed: of the start.
        success: whether it is one, see `run_episode`.
        crashed: whether the ego has crashed.
        at_fault: whether it has, and is at fault.
        off_road: whether it has left the road.
        steps: of the environment.
        reward: the sum over all steps.
        frames: of the simulation.
        distance: the sum of speed times time [m].
        seconds: duration of the frames.
        stood: duration of those in which it was slower than 1 m/s [s].
        max_acceleration: the largest acceleration in any frame [m/s^2].
        max_acceleration_of_centre: that of the middle of the car, which also goes sideways when the front wheels are
            turned [m/s^2].
        squared_jerk: the mean of the squared change of acceleration per second [m^2/s^6].
        decisions: duration of each decision, without compilation [s].
        late: number of plans that were not ready within their budget.
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
    frames: int
    distance: float
    seconds: float
    stood: float
    max_acceleration: float
    max_acceleration_of_centre: float
    squared_jerk: float
    decisions: tuple[float, ...]
    late: int
    sources: Counter[str]
    rungs: Counter[str]


def check_driver(name: str) -> None:
    """Refuse a driver that is not known.

    Raises:
        ModuleNotFoundError: if an agent needs what is not installed.
        ValueError: naming those that are.
    """
    if gone := retired.replacement(retired.DRIVERS, *name.split("+")):
        raise ValueError(gone)
    if is_agent(name):
        policy_of(name)
    elif name not in OTHERS:
        try:
            RoadSettings.read(driver_config(name))
        except ValueError as error:
            known = ", ".join([*OTHERS, *DRIVERS, f"DRIVER[{INTENTIONS}]", "AGENT.zip"])
            raise ValueError(f"unknown driver {name!r}; the drivers are {known} ({error})") from None


def make_driver(block: Block, **options: Any) -> gym.Env:
    """Make an environment that drives itself: its ``step`` ignores the action.

    Args:
        block: says what drives where.
        options: of ``gym.make``.
    """
    scene, config = block.scene, {"other_vehicles_type": TRAFFIC.get(block.traffic)}
    if scene == RECORDED:
        scene, config = RECORDED_ID, {"traffic": block.traffic, **block.starts[0].config}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*is out of date", DeprecationWarning)
        env = gym.make(scene, config=config, disable_env_checker=True, **options)
    if is_agent(block.driver):
        return Agent(env, block.driver)
    return OTHERS[block.driver](env) if block.driver in OTHERS else drive(env, driver_config(block.driver))


_kept_driver = cache(make_driver)


def run_episode(block: Block, seed: int, env: gym.Env | None = None, then: Callable[[], None] | None = None) -> Episode:
    """Drive one episode.

    It is no success after a crash. Where the scene has a goal, `ms_highway.road.stock.success` decides at its end;
    elsewhere, the ego has stayed on the road in all frames.

    Args:
        block: says what drives where.
        seed: of the start.
        env: what `make_driver` returned for the block; by default, one that this process keeps.
        then: is called after every frame.
    """
    env = env or _kept_driver(block)
    env.reset(seed=seed, options={"config": block.starts[seed].config} if block.starts else None)
    inner: Any = env.unwrapped
    exported = Drive(inner) if block.exports else None
    watch = Watch(inner, *([then] if then else []), *([exported.see] if exported else []))
    rewards, roads, done = [], [], False
    longest = max(LONGEST, inner.config.get("duration", 0.0))
    while not done:
        _, reward, terminated, truncated, info = env.step(None)
        rewards.append(float(reward))
        roads.append(info["road"])
        done = terminated or truncated or inner.time >= longest
    off_at_end = terminated and not watch.crashed and not inner.vehicle.on_road
    off_road = inner.off_road if block.scene == RECORDED else bool(watch.off_road or off_at_end)
    reached = success(inner)
    if exported and block.exports:
        exported.write(block.exports / block.traffic / file_name(block.driver), block.name(seed))
    return Episode(
        seed=seed,
        success=not watch.crashed and bool(not off_road if reached is None else reached),
        crashed=watch.crashed,
        at_fault=watch.at_fault,
        off_road=off_road,
        steps=len(rewards),
        reward=sum(rewards),
        **watch.motion(),
        decisions=tuple(seconds for road in roads for seconds in road["decisions"] if seconds >= 0),
        late=sum(road.get("late", 0) for road in roads),
        sources=Counter(source for road in roads for source in road.get("sources", ()) if source),
        rungs=sum((Counter(road.get("model_counts", {})) for road in roads), Counter[str]()),
    )


def file_name(text: str) -> str:
    """Return a text as part of a file's name."""
    return re.sub(r"[:/\\]", "_", text)


def film(block: Block, seed: int, path: Path) -> None:
    """Drive an episode again and write it to a video file, ``.gif`` or ``.mp4``, that plays at true speed.

    Where the ego takes the place of a recorded vehicle, the recording is shown above, each under its name.

    Raises:
        OSError: if it cannot be written.
    """
    from ms_highway.visualization.video import named, write

    shown = [block]
    if block.starts and isinstance(block.starts[seed].ego, int):
        shown.insert(0, block._replace(driver=HUMAN, traffic="replay"))
    films, rates = zip(*(_filmed(one, seed) for one in shown), strict=True)
    if len(shown) > 1:
        films = tuple(map(named, films, ("the recorded driver", block.driver)))
    longest = max(map(len, films))
    whole = [[*pictures, *[pictures[-1]] * (longest - len(pictures))] for pictures in films]
    write([np.vstack(pictures) for pictures in zip(*whole, strict=True)], path, rates[0])


def _filmed(block: Block, seed: int) -> tuple[list[np.ndarray], float]:
    """Return the pictures of an episode, and how many there are of a second."""
    from ms_highway.visualization.video import scaled

    env: Any = make_driver(block, render_mode="rgb_array")
    frequency, pictures, frames = env.unwrapped.config["simulation_frequency"], [], count()
    every = max(1, round(frequency / FRAMES_PER_SECOND))

    def picture() -> None:
        if next(frames) % every == 0:
            pictures.append(env.render())

    show(env)
    run_episode(block._replace(exports=None), seed, env, picture)
    env.close()
    height, width = pictures[0].shape[:2]
    return scaled(pictures, width * min(HIGHEST, height) // height), frequency / every


def summary(block: Block, episodes: Sequence[Episode]) -> dict[str, Any]:
    """Return the figures of a driver in a scene, for JSON.

    * ``success``, ``off_road``: shares of the episodes in which the goal was reached, and the road was left;
    * ``collisions``, ``at_fault``: numbers of episodes in which the ego crashed, and was at fault;
    * ``reward_per_step``, ``return``: mean reward over all steps of all episodes, and its sum per episode;
    * ``mean_speed``: over all frames [m/s]; ``stood``: mean time slower than 1 m/s in an episode [s];
    * ``max_acceleration``, ``max_acceleration_of_centre``: largest in any frame [m/s^2];
    * ``jerk``: root mean square over all frames [m/s^3];
    * ``p50_ms``, ``p99_ms``: quantiles over all decisions of all episodes [ms];
    * ``late``: share of the plans that were not ready within their budget;
    * ``steps``: mean number per episode; ``goal_seconds``: mean duration of those that reached the goal, None without
      any [s];
    * ``sources``: shares of the decisions by what drove, where the driver says so;
    * ``rungs``: shares of the cars that each rung predicted;
    * ``episodes``, ``seeds``, ``traffic``, ``label``: their number, the first seed and how many, the type of the other
      vehicles, and ``unphysical`` if ``max_acceleration`` is above `UNPHYSICAL`.
    """
    of = pd.DataFrame(map(vars, episodes))
    p50, p99 = np.quantile(np.concatenate(of["decisions"]), [0.5, 0.99])
    largest, reached = of["max_acceleration"].max(), of["seconds"][of["success"]]
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
        "goal_seconds": None if reached.empty else reached.mean(),
        "sources": _shares(of["sources"]),
        "rungs": _shares(of["rungs"]),
        "episodes": len(episodes),
        "seeds": [episodes[0].seed, len(episodes)],
        "traffic": block.traffic,
        "label": "unphysical" if largest > UNPHYSICAL else "",
    }
    return {name: figure.item() if isinstance(figure, np.generic) else figure for name, figure in figures.items()}


def _shares(counters: Iterable[Counter[str]]) -> dict[str, float]:
    counts = sum(counters, Counter[str]())
    return {name: number / counts.total() for name, number in counts.items()}


def row(block: Block, episode: Episode) -> dict[str, Any]:
    """Return an episode as a row of a table."""
    own = {"scene": block.scene, "driver": block.driver, "traffic": block.traffic}
    start = {"start": block.name(episode.seed)} if block.starts else {}
    left_out = ("decisions", "sources", "rungs")
    numbers = {name: value for name, value in vars(episode).items() if name not in left_out}
    times = {"p50_ms": 1e3 * float(np.median(episode.decisions)), "max_ms": 1e3 * max(episode.decisions)}
    return own | start | numbers | times
