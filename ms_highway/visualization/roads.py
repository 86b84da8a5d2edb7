"""Show how drivers fare on stock roads and in recorded traffic: what `ms-highway bench road --json` writes."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import msgspec
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from msgspec import Meta
from rich.table import Table
from scipy.stats import binomtest

from ms_highway.experiments.analysis.summary import CONFIDENCE
from ms_highway.planning.human_models import cheapest_first
from ms_highway.planning.road.settings import MODELS
from ms_highway.runtime.files import read_json, reading
from ms_highway.runtime.structures import Finite, NotNegative
from ms_highway.visualization.colors import choosing_shades, light_grid
from ms_highway.visualization.section import Section
from ms_highway.visualization.tables import grid

REMEDY = "write it again with `ms-highway bench road --json`"
ROW = 0.22  # inches, of a driver in a scene
FIRST, OTHERS = choosing_shades("learned")[0], choosing_shades("switching")[1]  # colours
RIVALS = 4  # of which the answer tells, at most

Share = Annotated[float, Meta(ge=0, le=1)]
Count = Annotated[int, Meta(ge=0)]


class Fared(msgspec.Struct, frozen=True):
    """How a driver fared in a scene, see `ms_highway.benchmarks.road.episodes.summary`, whose keys these are."""

    success: Share
    collisions: Count
    at_fault: Count
    off_road: Share
    reward_per_step: Finite
    mean_speed: Finite
    max_acceleration: NotNegative
    jerk: NotNegative
    p50_ms: NotNegative | None
    p99_ms: NotNegative | None
    episodes: Annotated[int, Meta(ge=1)]
    seeds: tuple[Count, Count]
    traffic: str
    label: str
    late: Share = 0.0
    goal_seconds: NotNegative | None = None
    judged: Count = 0
    agrees: Count = 0
    feasible: Count = 0
    rungs: dict[str, Share] = {}
    bounded: Count = 0
    solvable: Share = 0.0
    solved: Share | None = None
    regret: Finite | None = None
    waited: NotNegative | None = None

    def __post_init__(self) -> None:
        if (self.p50_ms is None) != (self.p99_ms is None):
            raise ValueError(f"p50_ms is {self.p50_ms}, but p99_ms {self.p99_ms}")

    @property
    def interval(self) -> tuple[float, float]:
        """The interval of success, by Wilson's score."""
        found = binomtest(round(self.success * self.episodes), self.episodes)
        low, high = found.proportion_ci(CONFIDENCE, "wilson")
        return float(low), float(high)

    @property
    def arrives(self) -> str:
        """Success in percent with its interval."""
        low, high = self.interval
        return f"{100 * self.success:.0f} % ({100 * low:.0f}, {100 * high:.0f})"


Scenes = Mapping[str, Mapping[str, Fared]]
"""By scene and driver."""


def read_roads(path: Path) -> Scenes:
    """Read what ``ms-highway bench road --json`` wrote.

    Raises:
        ValueError: if the file cannot be read, or holds no such figures.
    """
    with reading(path, REMEDY, " as figures of drivers"):
        return fared(read_json(path))


def fared(figures: object) -> Scenes:
    """Return figures by scene and driver, checked.

    Raises:
        msgspec.ValidationError: for other figures.
    """
    return msgspec.convert(figures, dict[str, dict[str, Fared]])


def driver_table(title: str, drivers: Mapping[str, Fared], *without: str) -> Table:
    """Return a table of how drivers fared in a scene, a row for each, but for the columns of some headings."""
    rows = driver_rows(drivers, *without)
    return grid(title, rows, left=1 + ("label" in rows[0]))


def driver_rows(drivers: Mapping[str, Fared], *without: str) -> list[dict[str, str]]:
    """Return a row of texts for each driver, without the columns that have nothing to say."""
    rungs = cheapest_first([*MODELS, *(rung for one in drivers.values() for rung in one.rungs)])
    rows = []
    for driver, one in drivers.items():
        first, count = one.seeds
        row = {
            "driver": driver,
            "label": one.label,
            "success (90 % interval)": one.arrives,
            "collisions (at fault)": f"{one.collisions} ({one.at_fault})",
            "off road": f"{100 * one.off_road:.0f} %" if one.off_road else "",
            "s to goal": _text(one.goal_seconds, ".1f"),
            "reward per step": f"{one.reward_per_step:.3f}",
            "m/s": f"{one.mean_speed:.1f}",
            "m/s² at most": f"{one.max_acceleration:.1f}",
            "jerk, m/s³": f"{one.jerk:.1f}",
            f"{' / '.join(rungs)} %": " / ".join(f"{100 * one.rungs.get(rung, 0.0):.0f}" for rung in rungs)
            if one.rungs
            else "",
            "ms p50, p99": "" if one.p50_ms is None else f"{one.p50_ms:.1f}, {one.p99_ms:.1f}",
            "late": f"{100 * one.late:.0f} %" if one.late else "",
            "judge agrees, feasible": f"{one.agrees}, {one.feasible} of {one.judged}" if one.judged else "",
            "solved": "" if one.solved is None else f"{100 * one.solved:.0f} % of {one.solvable * one.bounded:.0f}",
            "regret": _text(one.regret, ".3f"),
            "waited, s": _text(one.waited, ".1f"),
            "traffic": one.traffic,
            "episodes": f"{count} from {first} on",
        }
        rows.append(row)
    told = [heading for heading in rows[0] if heading not in without and any(row[heading] for row in rows)]
    return [{heading: row[heading] for heading in told} for row in rows]


def _text(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def roads_section(path: Path) -> Section:
    """Return the section of a file of figures.

    Raises:
        ValueError: as `read_roads`, or if it holds no driver.
    """
    scenes = {scene: drivers for scene, drivers in read_roads(path).items() if drivers}
    if not scenes:
        raise ValueError(f"{path} holds no driver yet; let `ms-highway bench road` finish one")
    first = next(iter(next(iter(scenes.values()))))
    caption = "Share of the episodes that succeed, with its 90 % interval (Wilson), by scene and driver."
    return Section(
        f"Roads: {path}",
        "Who reaches its goal without a collision, and what does a decision cost?",
        successes_told(scenes, first),
        [driver_table(scene, drivers) for scene, drivers in scenes.items()],
        {"success": (success_figure(scenes), caption)},
    )


def successes_told(scenes: Scenes, first: str) -> str:
    """Say how a driver fares, and beside it those that drove most of its scenes; in means over scenes if several."""
    own = [scene for scene, drivers in scenes.items() if first in drivers]
    figures = [scenes[scene][first] for scene in own]
    hit, fault = sum(one.collisions for one in figures), sum(one.at_fault for one in figures)
    episodes = sum(one.episodes for one in figures)
    shared = {
        name: [scene for scene in own if name in scenes[scene]]
        for name in dict.fromkeys(name for scene in own for name in scenes[scene])
        if name != first
    }
    rivals = sorted(shared, key=lambda name: -len(shared[name]))[:RIVALS]
    if len(own) == 1:
        (scene,) = own
        success = f"{first} succeeds in {scenes[scene][first].arrives} of its episodes of {scene}"
        beside = [f"{name} in {scenes[scene][name].arrives}" for name in rivals]
    else:
        success = f"{first} succeeds in {_mean(scenes, own, first)} of its episodes, in the mean of {len(own)} scenes"
        beside = [
            f"{name} in {_mean(scenes, shared[name], name)} in {len(shared[name])} of them, where {first} does in "
            f"{_mean(scenes, shared[name], first)}"
            for name in rivals
        ]
    times = sorted({f"{one.p50_ms:.1f}" for one in figures if one.p50_ms is not None}, key=float)
    cost = (
        f" A decision of {first} takes {' to '.join(dict.fromkeys((times[0], times[-1])))} ms in the median."
        if times
        else ""
    )
    collisions = f"it collides in {hit} of {episodes} episodes, in {fault} at fault"
    return f"{'; '.join([success, *beside])}. Altogether, {collisions}.{cost}"


def _mean(scenes: Scenes, some: Sequence[str], driver: str) -> str:
    return f"{100 * sum(scenes[scene][driver].success for scene in some) / len(some):.0f} %"


def success_figure(scenes: Scenes) -> Figure:
    """Draw the share of successful episodes, with intervals: a row for each driver in each scene."""
    rows = [(scene, driver, one) for scene, drivers in scenes.items() for driver, one in drivers.items()]
    starts = [place for place, (scene, *_) in enumerate(rows) if not place or rows[place - 1][0] != scene]
    heights = [place + sum(start <= place for start in starts) for place in range(len(rows))]  # a line for its name
    figure = Figure(figsize=(8, 1 + ROW * (len(rows) + len(starts))), layout="constrained")
    axes, first = figure.subplots(), rows[0][1]
    for height, (_, driver, one) in zip(heights, rows, strict=True):
        ends = [[abs(end - one.success)] for end in one.interval]
        color = FIRST if driver == first else OTHERS
        axes.errorbar([one.success], [height], xerr=ends, fmt="o", capsize=2, color=color, markersize=4)
    for start in starts:
        axes.text(0.0, heights[start] - 1, rows[start][0], fontweight="bold", va="center")
    axes.set_yticks(heights, [Path(driver).stem if driver.endswith(".zip") else driver for _, driver, _ in rows])
    axes.set_ylim(heights[-1] + 0.8, -0.8)
    axes.xaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_xlim(-0.02, 1.02)
    axes.set_xlabel("episodes that succeed")
    light_grid(axes, "x")
    return figure
