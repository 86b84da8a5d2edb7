"""Very many simulated episodes, kept in parts that an interrupted run goes on with and that need not fit in memory.

A part is a Parquet file: small, typed, and read by ``pandas.read_parquet`` alone or with its whole directory. It is
written under another name and moved to its own when it is whole, so that every part is either whole or not there.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import sleep
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from jax.sharding import Mesh
from pyarrow import parquet

from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.settings import SETTINGS_FILE, check_settings
from ms_highway.experiments.simulated import Batch, make_batch, run_episodes, summarised, tabulated
from ms_highway.experiments.summary import earned
from ms_highway.runtime.files import replacing

__all__ = [
    "ALONE",
    "EPISODES",
    "PART",
    "STEPS",
    "Sweep",
    "Worker",
    "missing",
    "prices",
    "read_sweep",
    "run_sweep",
    "sweep_summary",
    "wait_for_all",
]

EPISODES, STEPS = "episodes", "steps"
"""Directories of a sweep's parts, with a row per episode and per step."""

PART = 1024
"""Usual number of episodes in a part."""

MOST_PRICES = 10_000

PAUSE = 0.2  # s, between looks at what other processes have written


@dataclass(frozen=True)
class Sweep:
    """What is simulated, and what is kept of it.

    Attributes:
        comparison: of a single scenario.
        part: number of episodes in a part. There is one per device in memory, so that this grows with it, and not with
            the number of episodes.
        steps: whether a row per step is kept as well.
    """

    comparison: Comparison
    part: int = PART
    steps: bool = False

    @property
    def scenario(self) -> str:
        """The name of the scenario."""
        (scenario,) = self.comparison.controllers
        return scenario

    @property
    def episodes(self) -> int:
        """How many there are, of all controllers together."""
        return self.comparison.seeds * len(self.comparison.controllers[self.scenario])

    @property
    def parts(self) -> int:
        """How many there are."""
        return -(-self.episodes // self.part)

    def size(self, part: int) -> int:
        """The number of episodes in a part: in the last one, what is left."""
        return min(self.part, self.episodes - part * self.part)

    def settings(self) -> dict[str, Any]:
        """What decides which numbers are found in which part, by the names of the options."""
        comparison = self.comparison
        return {
            **comparison.common_config(),
            "costs": comparison.costs,
            "controllers": comparison.controllers,
            "episodes": comparison.seeds,
            "seed": comparison.first_seed,
            "part": self.part,
            "steps": self.steps,
        }

    def rows(self, part: int) -> dict[str, int]:
        """The number of rows of a part in each of the directories."""
        rows = {EPISODES: self.size(part)}
        return rows | {STEPS: self.size(part) * self.comparison.steps(self.scenario)} if self.steps else rows


@dataclass(frozen=True)
class Worker:
    """One of several processes that share a sweep: number ``place`` computes every part k with ``k % of == place``."""

    place: int = 0
    of: int = 1

    def parts(self, sweep: Sweep) -> range:
        """The parts that this process computes."""
        return range(self.place, sweep.parts, self.of)


ALONE = Worker()


def prices(text: str) -> list[float]:
    """Lambdas from a text: ``LOW:HIGH:COUNT``, evenly spaced in their logarithm, or several with commas between.

    Spaced ones are rounded to three significant digits, which make short names of controllers.

    Raises:
        ValueError: if the text is neither, names negative lambdas, or spaces them so closely that some are equal.
    """
    try:
        if ":" in text:
            low, high, count = text.split(":")
            if not 0 < float(low) < float(high) < np.inf or not 2 <= int(count) <= MOST_PRICES:
                raise ValueError
            values = [float(f"{value:.3g}") for value in np.geomspace(float(low), float(high), int(count))]
            if len(set(values)) < int(count):
                raise ValueError
        else:
            values = [float(part) for part in text.split(",")]
            if not all(0 <= value < np.inf for value in values):
                raise ValueError
    except ValueError:
        remedy = (
            "give LOW:HIGH:COUNT with 0 < LOW < HIGH and two or more that differ in three digits, such as 0.001:10:25, "
            "or lambdas like 0.1,0.5"
        )
        raise ValueError(f"lambdas are {text!r}; {remedy}") from None
    return list(dict.fromkeys(abs(value) for value in values))  # also of -0


def run_sweep(sweep: Sweep, directory: Path, mesh: Mesh | None = None, worker: Worker = ALONE) -> Iterator[int]:
    """Compute the parts that a directory lacks and write each when it is done.

    Args:
        sweep: what to compute.
        directory: where the parts are.
        mesh: devices, each of which computes a part at a time; see `ms_highway.simulation.devices.device_mesh`.
        worker: which of the parts this process computes.

    Yields:
        How many of this process's episodes are there: first what earlier runs have left, then after every part.

    Raises:
        ValueError: if the sweep is impossible, or the directory holds something else.
    """
    batch = make_batch(sweep.comparison, sweep.scenario)
    _take_up(sweep, directory, worker)
    mine, together = worker.parts(sweep), 1 if mesh is None else mesh.size
    lacking = [part for part in missing(sweep, directory) if part in mine]
    count = sum(sweep.size(part) for part in mine) - sum(sweep.size(part) for part in lacking)
    yield count
    for first in range(0, len(lacking), together):
        for part in _compute(sweep, batch, lacking[first : first + together], directory, mesh):
            count += sweep.size(part)
            yield count


def _compute(sweep: Sweep, batch: Batch, parts: list[int], directory: Path, mesh: Mesh | None) -> Iterator[int]:
    """Compute parts, one on each device, and write them, the row per episode last: then the part is done."""
    shares = [batch.keys(part * sweep.part, (part + 1) * sweep.part) for part in parts]
    keys = [key for share in shares for key in share]  # only the sweep's last part is smaller, and it comes last
    records = run_episodes(batch, keys, mesh)
    first = 0
    for part, share in zip(parts, shares, strict=True):
        own = type(records)(*(numbers[first : first + len(share)] for numbers in records))
        first += len(share)
        if sweep.steps:
            _write(tabulated(batch, share, own), _file(directory, STEPS, part))
        _write(summarised(batch, share, own), _file(directory, EPISODES, part))
        yield part


def _write(table: pd.DataFrame, file: Path) -> None:
    with replacing(file) as path:
        parquet.write_table(pa.Table.from_pandas(table, preserve_index=False), path)


def _file(directory: Path, kind: str, part: int) -> Path:
    return directory / kind / f"part-{part:06d}.parquet"


def missing(sweep: Sweep, directory: Path) -> list[int]:
    """The parts that a directory lacks, of any process."""
    kinds = list(sweep.rows(0))
    there = {kind: {file.name for file in (directory / kind).glob("part-*")} for kind in kinds}
    return [
        part
        for part in range(sweep.parts)
        if not all(_file(directory, kind, part).name in there[kind] for kind in kinds)
    ]


def wait_for_all(sweep: Sweep, directory: Path) -> None:
    """Wait until the processes that share a sweep have written all parts."""
    while missing(sweep, directory):
        sleep(PAUSE)


def _take_up(sweep: Sweep, directory: Path, worker: Worker) -> None:
    """Prepare the directory, which the first process does for all.

    Raises:
        ValueError: if it holds a sweep of other settings, other results, or a part that cannot be read.
    """
    while worker.place > 0 and not (directory / SETTINGS_FILE).exists():
        sleep(PAUSE)
    check_settings(directory, sweep.settings())
    for part in sorted(set(worker.parts(sweep)) - set(missing(sweep, directory))):
        for kind, rows in sweep.rows(part).items():
            _check(_file(directory, kind, part), rows)
    if worker.place == 0:
        with replacing(directory / SETTINGS_FILE) as path:
            path.write_text(json.dumps(sweep.settings(), indent=2) + "\n")


def _check(file: Path, rows: int) -> None:
    try:
        found = parquet.read_metadata(file).num_rows
    except (OSError, pa.ArrowException) as error:
        raise ValueError(f"{file} cannot be read ({error}); remove it, to have it computed again") from error
    if found != rows:
        raise ValueError(f"{file} has {found} rows and should have {rows}; remove it, to have it computed again")


def read_sweep(sweep: Sweep, directory: Path) -> pd.DataFrame:
    """A row per episode of a finished sweep, seed by seed; see `ms_highway.experiments.simulated.summarised`."""
    return pd.concat([pd.read_parquet(_file(directory, EPISODES, part)) for part in range(sweep.parts)])


def sweep_summary(episodes: pd.DataFrame) -> pd.DataFrame:
    """One row per scenario and controller, with those columns of `ms_highway.experiments.summary.summary` that are not
    measured.

    Args:
        episodes: a row per episode, of `read_sweep`.
    """
    rows = []
    for (scenario, controller), some in episodes.groupby(["scenario", "controller"], sort=False):
        rows.append(
            {
                "scenario": scenario,
                **earned(controller, some["reward"]),
                "counted_ms": 1e3 * some["counted_seconds"].mean(skipna=False),
                **{name: some[name].mean() for name in some if name.startswith("share_")},
                "collision_episodes": int((some["collisions"] > 0).sum()),
                "fallbacks": int(some["fallbacks"].sum()),
            }
        )
    return pd.DataFrame(rows)
