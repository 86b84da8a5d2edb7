"""Drive episodes of a stock scene, measure them, film them and summarise them."""

import re
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from ms_highway.benchmarks.road import (
    HUMAN,
    INTENTIONS,
    REACTIVE,
    RECORDED,
    RECORDED_ID,
    SEARCH,
    TRAFFIC,
    driver_config,
    is_agent,
)
from ms_highway.benchmarks.road.export import Drive
from ms_highway.benchmarks.road.judge import Verdict, judge_drive
from ms_highway.benchmarks.road.measures import Watch, has_ended
from ms_highway.benchmarks.road.peers import PEERS, Agent, Peer, policy_of
from ms_highway.benchmarks.road.reactive import Reactive, ReactiveDefault
from ms_highway.benchmarks.road.recorded import Human, RecordedStart
from ms_highway.benchmarks.road.search import Search
from ms_highway.envs.road import drive
from ms_highway.envs.road.graphics import show
from ms_highway.envs.road.settings import DRIVERS, RoadSettings
from ms_highway.envs.road.stock import success

UNPHYSICAL = 10.0
"""Acceleration [m/s^2] that no tyres hold."""

FRAMES_PER_SECOND = 10  # of films, at most
HIGHEST = 360  # px, of films: pages load them

OTHERS: dict[str, type[Peer]] = {
    **PEERS,
    SEARCH: Search,
    HUMAN: Human,
    **dict(zip(REACTIVE, (Reactive, ReactiveDefault), strict=True)),
}
"""Wrappers of the drivers that are not this package's own, by name."""


class Block(NamedTuple):
    """Episodes that belong together.

    Attributes:
        scene: identifier of a stock environment, or `ms_highway.benchmarks.road.RECORDED`.
        driver: name of what drives the ego.
        traffic: a name of `ms_highway.benchmarks.road.TRAFFIC`, or of ``RECORDED_TRAFFIC``.
        starts: in recordings, of which the seeds are numbers.
        exports: directory for drives in recordings, None to write none.
        judged: whether exported drives are judged.
    """

    scene: str
    driver: str
    traffic: str = "idm"
    starts: tuple[RecordedStart, ...] = ()
    exports: Path | None = None
    judged: bool = False

    def name(self, seed: int) -> str:
        """Return the name of a start, for logs."""
        return self.starts[seed].name if self.starts else str(seed)

    def options(self, seed: int) -> dict[str, Any] | None:
        """Return the options of the reset that leads to a start."""
        return {"config": self.starts[seed].config} if self.starts else None


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
        verdict: of an outside judge, None without one.
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
    verdict: Verdict | None = None

    @property
    def agrees(self) -> bool | None:
        """Whether the judge says of success, collision and road what the environment does; None without a judge."""
        if self.verdict is None:
            return None
        told = self.verdict.reached and not self.verdict.collision and not self.verdict.off_road
        own = self.success, self.crashed, self.off_road
        return own == (told, self.verdict.collision, self.verdict.off_road)


def check_driver(name: str) -> None:
    """Refuse a driver that is not known.

    Raises:
        ModuleNotFoundError: if an agent needs what is not installed.
        ValueError: naming those that are.
    """
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

    It is no success after a crash. Where the scene has a goal, `ms_highway.envs.road.stock.success` decides at its end;
    elsewhere, the ego has stayed on the road in all frames.

    Args:
        block: says what drives where.
        seed: of the start.
        env: what `make_driver` returned for the block; by default, one that this process keeps.
        then: is called after every frame.
    """
    env = env or _kept_driver(block)
    env.reset(seed=seed, options=block.options(seed))
    inner: Any = env.unwrapped
    drive = Drive(inner) if block.exports else None
    every_frame = [*([then] if then else []), *([drive.see] if drive else [])]
    watch, done = Watch(inner, *every_frame), False
    rewards, roads = [], []
    while not done:
        _, reward, terminated, truncated, info = env.step(None)
        rewards.append(float(reward))
        roads.append(info["road"])
        done = has_ended(inner, terminated, truncated)
    off_road = bool(watch.off_road or (terminated and not watch.crashed and not inner.vehicle.on_road))
    if block.scene == RECORDED:
        off_road = inner.off_road
    reached = success(inner)
    return Episode(
        verdict=_exported(drive, block, seed) if drive else None,
        seed=seed,
        success=not watch.crashed and bool(not off_road if reached is None else reached),
        crashed=watch.crashed,
        at_fault=watch.at_fault,
        off_road=off_road,
        steps=len(rewards),
        reward=sum(rewards),
        **watch.motion(),
        decisions=tuple(seconds for road in roads for seconds in road["decisions"]),
        late=sum(road.get("late", 0) for road in roads),
        sources=Counter(source for road in roads for source in road.get("sources", ())),
        rungs=sum((road.get("model_counts", Counter()) for road in roads), Counter[str]()),
    )


def _exported(drive: Drive, block: Block, seed: int) -> Verdict | None:
    """Write a drive, and return what the judge says of it, if it is to be judged."""
    assert block.exports
    place = block.exports / block.traffic / re.sub(r"[:/\\]", "_", block.driver) / block.name(seed)
    scenario, solution = (place.with_name(f"{place.name}.{kind}") for kind in ("xml", "solution.xml"))
    drive.write(scenario, solution)
    return judge_drive(scenario, solution) if block.judged else None


def film(block: Block, seed: int, path: Path) -> None:
    """Drive an episode again and write it to a video file, ``.gif`` or ``.mp4``, that plays at true speed.

    Where the ego takes the place of a recorded vehicle, the recording is shown above.

    Raises:
        OSError: if it cannot be written.
    """
    from ms_highway.visualization.video import write

    frames, rate = _filmed(block, seed)
    if block.starts and isinstance(block.starts[seed].ego, int):
        above, _ = _filmed(block._replace(driver=HUMAN, traffic="replay"), seed)
        longest = max(len(frames), len(above))
        whole = [[*one, *[one[-1]] * (longest - len(one))] for one in (above, frames)]
        frames = [np.vstack(pair) for pair in zip(*whole, strict=True)]
    write(frames, path, rate)


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
    * ``judged``, ``agrees``, ``feasible``: numbers of drives that were judged, of which the judge says what the
      environment does, and that it could have driven with CommonRoad's vehicle;
    * ``sources``: shares of the decisions by what drove, where the driver says so;
    * ``rungs``: shares of the cars that each rung predicted;
    * ``episodes``, ``seeds``, ``traffic``, ``label``: their number, the first seed and how many, the type of the other
      vehicles, and ``unphysical`` if ``max_acceleration`` is above `UNPHYSICAL`, ``privileged`` for the search
      and for who knows how others were recorded to go.
    """
    of = SimpleNamespace(**{name: [getattr(each, name) for each in episodes] for name in vars(episodes[0])})
    p50, p99 = np.quantile(1e3 * np.concatenate(of.decisions), [0.5, 0.99])
    reached = [one.seconds for one in episodes if one.success]
    judged = [one for one in episodes if one.verdict]
    figures = {
        "success": np.mean(of.success),
        "collisions": sum(of.crashed),
        "at_fault": sum(of.at_fault),
        "off_road": np.mean(of.off_road),
        "reward_per_step": sum(of.reward) / sum(of.steps),
        "return": np.mean(of.reward),
        "mean_speed": sum(of.distance) / sum(of.seconds),
        "stood": np.mean(of.stood),
        "max_acceleration": max(of.max_acceleration),
        "max_acceleration_of_centre": max(of.max_acceleration_of_centre),
        "jerk": np.sqrt(np.average(of.squared_jerk, weights=of.frames)),
        "p50_ms": p50,
        "p99_ms": p99,
        "late": sum(of.late) / sum(map(len, of.decisions)),
        "steps": np.mean(of.steps),
        "goal_seconds": float(np.mean(reached)) if reached else None,
        "judged": len(judged),
        "agrees": sum(bool(one.agrees) for one in judged),
        "feasible": sum(one.verdict.feasible for one in judged if one.verdict),
        "sources": _shares(of.sources),
        "rungs": _shares(of.rungs),
        "episodes": len(episodes),
        "seeds": [of.seed[0], len(episodes)],
        "traffic": block.traffic,
        "label": _label(block, max(of.max_acceleration)),
    }
    return {name: figure.item() if isinstance(figure, np.generic) else figure for name, figure in figures.items()}


def _label(block: Block, acceleration: float) -> str:
    labels = {"privileged": block.driver in (SEARCH, *REACTIVE), "unphysical": acceleration > UNPHYSICAL}
    return ", ".join(label for label, holds in labels.items() if holds)


def _shares(counters: Sequence[Counter[str]]) -> dict[str, float]:
    counts = sum(counters, Counter[str]())
    return {name: number / counts.total() for name, number in counts.items()}


def row(block: Block, episode: Episode) -> dict[str, Any]:
    """Return an episode as a row of a table."""
    milliseconds = 1e3 * np.array(episode.decisions)
    left_out = ("decisions", "sources", "rungs", "verdict")
    numbers = {name: value for name, value in vars(episode).items() if name not in left_out}
    verdict = {f"judge_{name}": value for name, value in vars(episode.verdict).items()} if episode.verdict else {}
    times = {"p50_ms": float(np.median(milliseconds)), "max_ms": float(np.max(milliseconds))}
    own = {"scene": block.scene, "driver": block.driver, "traffic": block.traffic}
    start = {"start": block.name(episode.seed)} if block.starts else {}
    return own | start | numbers | times | verdict
