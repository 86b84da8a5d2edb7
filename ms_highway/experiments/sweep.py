"""Simulate very many episodes, kept in parts that need not fit in memory, so that an interrupted run can be resumed.

A part is a Parquet file: small, typed, and read by ``pandas.read_parquet`` alone or with its whole directory. It is
written under another name and moved to its own when it is whole, so that every part is either whole or not there.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import ceil
from pathlib import Path
from typing import Any, TypeAlias

import pandas as pd
from jax.sharding import Mesh

from ms_highway.experiments.batch import Batch, Key, make_batch
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.records import check_numbers
from ms_highway.runtime.files import reading, replacing

EPISODES, STEPS = "episodes", "steps"
"""Directories of a sweep's parts, with a row per episode and per step."""

Tables: TypeAlias = dict[str, pd.DataFrame]
"""The rows of a part by directory; those of its episodes are written last: when they are there, the part is done."""


@dataclass(frozen=True)
class Sweep:
    """What is simulated, and where it is kept.

    Attributes:
        comparison: of a single scenario.
        directory: of the results.
        part: number of episodes in a part, of which one is in memory at a time.
        steps: whether a row per step is kept as well.
    """

    comparison: Comparison
    directory: Path
    part: int = 1024
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
    def parts(self) -> range:
        """The numbers of all parts."""
        return range(ceil(self.episodes / self.part))

    @cached_property
    def batch(self) -> Batch:
        """What simulates the episodes."""
        return make_batch(self.comparison, self.scenario)

    def settings(self) -> dict[str, Any]:
        """Return the settings that decide which numbers are in which part."""
        asked = {name: getattr(self.comparison, name) for name in ("controllers", "seeds", "first_seed")}
        return {**self.comparison.common_config(), **asked, "part": self.part, "steps": self.steps}

    def keys(self, part: int) -> list[Key]:
        """Return the episodes of a part, seed by seed."""
        return self.batch.keys(part * self.part, (part + 1) * self.part)

    def file(self, part: int, kind: str = EPISODES) -> Path:
        """Return the file of a part's rows."""
        return self.directory / kind / f"part-{part:06d}.parquet"

    def read(self) -> pd.DataFrame:
        """Return a row per episode of the parts that are there, seed by seed.

        Raises:
            ValueError: for a part that cannot be read, or holds something else.
        """
        tables = [pd.DataFrame()]
        for part in self.parts:
            if self.file(part).exists():
                with reading(self.file(part), "remove it, to have it computed again"):
                    tables.append(rows := pd.read_parquet(self.file(part)))
                    if [*zip(rows["controller"], rows["seed"], strict=True)] != self.keys(part):
                        raise ValueError("it holds other episodes than its number says")
                    check_numbers(rows)
        return pd.concat(tables[1:] or tables)


Compute: TypeAlias = Callable[[Sweep, Sequence[int]], Iterator[tuple[int, Tables]]]
"""Computes parts and yields each with its rows, in any order."""


def run_sweep(sweep: Sweep, compute: Compute) -> Iterator[int]:
    """Compute the parts that are missing and write each when it is done.

    Yields:
        The number of episodes there: first of those that earlier runs have left, then after every part.

    Raises:
        ValueError: if it cannot be simulated, or what is there cannot be read.
    """
    sweep.keys(0)  # refuses what cannot be simulated before anything is written
    number = len(sweep.read())
    yield number
    for part, tables in compute(sweep, [part for part in sweep.parts if not sweep.file(part).exists()]):
        for kind in (STEPS, EPISODES) if sweep.steps else (EPISODES,):
            with replacing(sweep.file(part, kind)) as path:
                tables[kind].to_parquet(path, index=False)
        number += len(tables[EPISODES])
        yield number


def compute_here(sweep: Sweep, parts: Sequence[int], mesh: Mesh | None = None) -> Iterator[tuple[int, Tables]]:
    """Compute parts in this process, one after the other; yield each with its rows.

    Args:
        sweep: which they are parts of.
        parts: their numbers.
        mesh: devices that share each, see `ms_highway.loop.devices.device_mesh`; by default, the first device.
    """
    for part in parts:
        keys = sweep.keys(part)
        steps = sweep.batch.steps_table(keys, sweep.batch.simulate(keys, mesh))
        yield part, {STEPS: steps, EPISODES: sweep.batch.episodes_table(steps)}
