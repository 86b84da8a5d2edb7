"""Show how drivers fare on stock roads and in recorded traffic: what `ms-highway bench road --json` writes."""

from collections.abc import Mapping
from pathlib import Path

import msgspec
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from scipy.stats import binomtest

from ms_highway.experiments.analysis.summary import CONFIDENCE
from ms_highway.planning.human_models import PACKAGE_MODELS
from ms_highway.runtime.files import read_json, reading
from ms_highway.visualization.section import Section
from ms_highway.visualization.tables import grid

REMEDY = "write it again with `ms-highway bench road --json`"
HEIGHT = 0.16  # inches, of a driver in a scene
MARKERS = "osD^vP*Xhd"


class Fared(msgspec.Struct, frozen=True):
    """How a driver fared in a scene, see `ms_highway.benchmarks.road.episodes.summary`, whose keys these are."""

    success: float
    collisions: int
    at_fault: int
    off_road: float
    reward_per_step: float
    mean_speed: float
    max_acceleration: float
    jerk: float
    p50_ms: float | None
    p99_ms: float | None
    episodes: int
    seeds: tuple[int, int]
    traffic: str
    label: str
    late: float = 0.0
    goal_seconds: float | None = None
    judged: int = 0
    agrees: int = 0
    feasible: int = 0
    rungs: dict[str, float] = {}
    bounded: int = 0
    solvable: float = 0.0
    solved: float | None = None
    regret: float | None = None
    waited: float | None = None

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


def driver_rows(drivers: Mapping[str, Fared]) -> list[dict[str, str]]:
    """Return a row of texts for each driver; without columns that have nothing to say."""
    rows = []
    for driver, one in drivers.items():
        shares = " / ".join(f"{100 * one.rungs.get(rung, 0.0):.0f}" for rung in PACKAGE_MODELS)
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
            f"{' / '.join(PACKAGE_MODELS)} %": shares if one.rungs else "",
            "ms p50, p99": "" if one.p50_ms is None else f"{one.p50_ms:.1f}, {one.p99_ms:.1f}",
            "late": f"{100 * one.late:.0f} %" if one.late else "",
            "judge agrees, feasible": f"{one.agrees}, {one.feasible} of {one.judged}" if one.judged else "",
            "solved": f"{100 * one.solved:.0f} % of {one.solvable * one.bounded:.0f}" if one.solved is not None else "",
            "regret": _text(one.regret, ".3f"),
            "waited, s": _text(one.waited, ".1f"),
            "traffic": one.traffic,
            "episodes": f"{count} from {first} on",
        }
        rows.append(row)
    told = [heading for heading in rows[0] if any(row[heading] for row in rows)]
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
    return Section(
        f"Roads: {path.stem}",
        "Who reaches its goal without a collision, and what does a decision cost?",
        successes_told(scenes),
        [grid(scene, driver_rows(drivers), 2) for scene, drivers in scenes.items()],
        {"success": (success_figure(scenes), "Share of the episodes that succeed, with its 90 % interval (Wilson).")},
    )


def successes_told(scenes: Scenes) -> str:
    """Say how the first driver fares in all scenes together that it has driven, and all others that have, too."""
    first = next(driver for drivers in scenes.values() for driver in drivers)
    own = [scene for scene, drivers in scenes.items() if first in drivers]
    names = [driver for driver in scenes[own[0]] if all(driver in scenes[scene] for scene in own)]
    parts = []
    for driver in names:
        figures = [scenes[scene][driver] for scene in own]
        episodes = sum(one.episodes for one in figures)
        success = sum(one.success * one.episodes for one in figures) / episodes
        together = msgspec.structs.replace(figures[0], success=success, episodes=episodes)
        hit, fault = (sum(getattr(one, name) for one in figures) for name in ("collisions", "at_fault"))
        parts.append(f"{driver} in {together.arrives}, with {hit} collisions, {fault} at fault")
    where = own[0] if len(own) == 1 else f"{len(own)} scenes"
    times = [one.p50_ms for scene in own for one in [scenes[scene][first]] if one.p50_ms is not None]
    cost = f" A decision of {first} takes {min(times):.1f} to {max(times):.1f} ms in the median." if times else ""
    return f"Success in {episodes} episodes of {where}: {'; '.join(parts)}.{cost}"


def success_figure(scenes: Scenes) -> Figure:
    """Draw the share of successful episodes by scene and driver, with intervals."""
    drivers = list(dict.fromkeys(driver for own in scenes.values() for driver in own))
    step = 1 / (len(drivers) + 1)
    height = 1.2 + HEIGHT * len(scenes) * (len(drivers) + 1)
    figure = Figure(figsize=(9, height), layout="constrained")
    axes = figure.subplots()
    for place, driver in enumerate(drivers):
        own = [(row, one[driver]) for row, one in enumerate(scenes.values()) if driver in one]
        heights = [row + step * (place + 1) - 0.5 for row, _ in own]
        values = [one.success for _, one in own]
        ends = [[abs(one.interval[end] - one.success) for _, one in own] for end in (0, 1)]
        axes.errorbar(values, heights, xerr=ends, fmt=MARKERS[place % len(MARKERS)], capsize=2, label=driver)
    axes.set_yticks(range(len(scenes)), list(scenes))
    axes.set_ylim(len(scenes) - 0.5, -0.5)
    for row in range(1, len(scenes)):
        axes.axhline(row - 0.5, color="#dddddd", linewidth=0.8)
    axes.xaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_xlim(-0.02, 1.02)
    axes.set_xlabel("episodes that succeed")
    axes.grid(axis="x", color="#eeeeee")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=5, frameon=False)
    return figure
