"""Simulate very many episodes, kept in parts that need not fit in memory, so that an interrupted run can be resumed.

A part is a Parquet file: small, typed, and read by ``pandas.read_parquet`` alone or with its whole directory. It is
written under another name and moved to its own when it is whole, so that every part is either whole or not there.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import sleep
from typing import Any

import pandas as pd
import pyarrow as pa
from jax.sharding import Mesh
from pyarrow import parquet

from ms_highway.experiments.analysis.summary import earned
from ms_highway.experiments.batch import EpisodeBatch
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.records import models_of, share_column
from ms_highway.experiments.resuming import check_settings
from ms_highway.experiments.settings import SETTINGS_FILE, write_settings
from ms_highway.experiments.simulated import any_batch, run_episodes, summarised, tabulated
from ms_highway.experiments.simulated_crowd import OUTCOMES
from ms_highway.runtime.files import replacing

__all__ = [
    "ALONE",
    "EPISODES",
    "PART",
    "STEPS",
    "Sweep",
    "Worker",
    "missing_parts",
    "read_sweep",
    "run_sweep",
    "sweep_summary",
    "wait_for_all",
]

EPISODES, STEPS = "episodes", "steps"
"""Directories of a sweep's parts, with a row per episode and per step."""

PART = 1024
"""Usual number of episodes in a part."""

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
        """The number of episodes, of all controllers together."""
        return self.comparison.seeds * len(self.comparison.controllers[self.scenario])

    @property
    def parts(self) -> int:
        """The number of parts."""
        return -(-self.episodes // self.part)

    def size(self, part: int) -> int:
        """Return the number of episodes in a part: in the last one, what is left."""
        return min(self.part, self.episodes - part * self.part)

    def settings(self) -> dict[str, Any]:
        """Return the settings that decide which numbers are in which part, by the names of the options."""
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
        """Return the number of rows of a part in each of the directories."""
        rows = {EPISODES: self.size(part)}
        return rows | {STEPS: self.size(part) * self.comparison.steps(self.scenario)} if self.steps else rows


@dataclass(frozen=True)
class Worker:
    """One of several processes that share a sweep: number ``place`` computes every part k with ``k % of == place``."""

    place: int = 0
    of: int = 1

    def parts(self, sweep: Sweep) -> range:
        """Return the parts that this process computes."""
        return range(self.place, sweep.parts, self.of)


ALONE = Worker()


def run_sweep(sweep: Sweep, directory: Path, mesh: Mesh | None = None, worker: Worker = ALONE) -> Iterator[int]:
    """Compute the parts that a directory lacks and write each when it is done.

    Args:
        sweep: what to compute.
        directory: where the parts are.
        mesh: devices, each of which computes a part at a time; see `ms_highway.simulation.devices.device_mesh`.
        worker: which of the parts this process computes.

    Yields:
        The number of this process's episodes there: first of those that earlier runs have left, then after every part.

    Raises:
        ValueError: if the sweep is impossible, or the directory holds something else.
    """
    batch = any_batch(sweep.comparison, sweep.scenario)
    _take_up(sweep, directory, worker)
    mine, together = worker.parts(sweep), 1 if mesh is None else mesh.size
    lacking = [part for part in missing_parts(sweep, directory) if part in mine]
    count = sum(sweep.size(part) for part in mine) - sum(sweep.size(part) for part in lacking)
    yield count
    for first in range(0, len(lacking), together):
        for part in _compute(sweep, batch, lacking[first : first + together], directory, mesh):
            count += sweep.size(part)
            yield count


def _compute(
    sweep: Sweep, batch: EpisodeBatch[Any], parts: list[int], directory: Path, mesh: Mesh | None
) -> Iterator[int]:
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
    return directory / kind / _name(part)


def _name(part: int) -> str:
    return f"part-{part:06d}.parquet"


def missing_parts(sweep: Sweep, directory: Path) -> list[int]:
    """Return the parts that a directory lacks, of any process."""
    names = [{file.name for file in (directory / kind).glob("part-*")} for kind in sweep.rows(0)]
    whole = set.intersection(*names)
    return [part for part in range(sweep.parts) if _name(part) not in whole]


def wait_for_all(sweep: Sweep, directory: Path) -> None:
    """Wait until the processes that share a sweep have written all parts."""
    while missing_parts(sweep, directory):
        sleep(PAUSE)


def _take_up(sweep: Sweep, directory: Path, worker: Worker) -> None:
    """Prepare the directory, which the first process does for all.

    Raises:
        ValueError: if it holds a sweep of other settings, other results, or a part that cannot be read.
    """
    while worker.place > 0 and not (directory / SETTINGS_FILE).exists():
        sleep(PAUSE)
    check_settings(directory, sweep.settings())
    for part in sorted(set(worker.parts(sweep)) - set(missing_parts(sweep, directory))):
        for kind, rows in sweep.rows(part).items():
            _check(_file(directory, kind, part), rows)
    if worker.place == 0:
        write_settings(directory, sweep.settings())


def _check(file: Path, rows: int) -> None:
    try:
        found = parquet.read_metadata(file).num_rows
    except (OSError, pa.ArrowException) as error:
        raise ValueError(f"{file} cannot be read ({error}); remove it, to have it computed again") from error
    if found != rows:
        raise ValueError(f"{file} has {found} rows and should have {rows}; remove it, to have it computed again")


def read_sweep(sweep: Sweep, directory: Path) -> pd.DataFrame:
    """Read a row per episode of a finished sweep, seed by seed; see `ms_highway.experiments.simulated.summarised`."""
    return pd.concat([pd.read_parquet(_file(directory, EPISODES, part)) for part in range(sweep.parts)])


def sweep_summary(episodes: pd.DataFrame) -> pd.DataFrame:
    """Return one row per scenario and controller: the columns of `ms_highway.experiments.analysis.summary` that are
    not measured, those of `ms_highway.experiments.simulated_crowd.OUTCOMES` only with several humans.

    Args:
        episodes: a row per episode, of `read_sweep`.
    """
    rows, shares = [], list(map(share_column, models_of(episodes, share_column)))
    for (scenario, controller), some in episodes.groupby(["scenario", "controller"], sort=False):
        rows.append(
            {
                "scenario": scenario,
                **earned(controller, some["reward"]),
                "counted_ms": 1e3 * some["counted_seconds"].mean(skipna=False),
                **{name: some[name].mean() for name in some if name in shares},
                "collision_episodes": int((some["collisions"] > 0).sum()),
                "fallbacks": int(some["fallbacks"].sum()),
                **{name: some[name].mean() for name in OUTCOMES if name in some},
            }
        )
    return pd.DataFrame(rows)
