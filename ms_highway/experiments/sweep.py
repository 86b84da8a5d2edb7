"""Simulate very many episodes, kept in parts that need not fit in memory, so that an interrupted run can be resumed.

A part is a Parquet file: small, typed, and read by ``pandas.read_parquet`` alone or with its whole directory. It is
written under another name and moved to its own when it is whole, so that every part is either whole or not there.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import pandas as pd
from jax.sharding import Mesh

from ms_highway.experiments.batch import Batch, Key, make_batch
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.records import check_numbers
from ms_highway.experiments.runner import run_parts
from ms_highway.runtime.files import reading, replacing

EPISODES, STEPS = "episodes", "steps"
"""Directories of a sweep's parts, with a row per episode and per step."""

Tables: TypeAlias = list[pd.DataFrame]
"""The rows of a part, in the order of `Sweep.kinds`."""


@dataclass(frozen=True)
class Sweep:
    """What is simulated, and where it is kept.

    Attributes:
        comparison: of a single scenario.
        directory: of the results.
        part: number of episodes in a part. There is one per device in memory, so that this grows with it, and not with
            the number of episodes.
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
        return range(-(-self.episodes // self.part))

    def settings(self) -> dict[str, Any]:
        """Return the settings that decide which numbers are in which part."""
        comparison = self.comparison
        return {
            **comparison.common_config(),
            "controllers": comparison.controllers,
            "seeds": comparison.seeds,
            "first_seed": comparison.first_seed,
            "part": self.part,
            "steps": self.steps,
        }

    def file(self, part: int, kind: str = EPISODES) -> Path:
        """Return the file of a part's rows of a kind."""
        return self.directory / kind / f"part-{part:06d}.parquet"

    @property
    def kinds(self) -> list[str]:
        """The kinds of rows that are kept, those of episodes last: when their file is there, the part is done."""
        return [STEPS, EPISODES] if self.steps else [EPISODES]

    def missing(self) -> dict[int, int]:
        """Return the parts that are not there yet, and how many episodes each has; check those that are there.

        Raises:
            ValueError: if the sweep is impossible, a part cannot be read or holds something else, or there is a file
                beside the parts that pandas would read with them.
        """
        there = {file for kind in (EPISODES, STEPS) for file in (self.directory / kind).glob("[!._]*")}
        files = {part: {self.file(part, kind) for kind in self.kinds} for part in self.parts}
        if strangers := sorted(there.difference(*files.values())):
            raise ValueError(f"{strangers[0]} is no part of this sweep, but would be read as one; move it away")
        batch, columns = make_batch(self.comparison, self.scenario), dict[str, list[str]]()
        for part in self.parts:
            if files[part] <= there:
                self._check(batch, part, columns)
        missing = [part for part in self.parts if not files[part] <= there]
        return {part: min(self.part, self.episodes - part * self.part) for part in missing}

    def _check(self, batch: Batch, part: int, columns: dict[str, list[str]]) -> None:
        """Check that the files of a part hold its episodes, in the same columns as other parts, by kind."""
        for kind in self.kinds:
            steps = batch.steps if kind == STEPS else 1
            expected = [key for key in self.keys(batch, part) for _ in range(steps)]
            with reading(self.file(part, kind), "remove it, to have it computed again"):
                rows = pd.read_parquet(self.file(part, kind))
                if [*rows[["controller", "seed"]].itertuples(index=False, name=None)] != expected:
                    raise ValueError("it holds other episodes than its number says")
                if list(rows) != columns.setdefault(kind, list(rows)):
                    raise ValueError("its columns are not those of the parts before")
                check_numbers(rows)

    def keys(self, batch: Batch, part: int) -> list[Key]:
        """Return the episodes of a part."""
        return batch.keys(part * self.part, (part + 1) * self.part)

    def write(self, part: int, tables: Tables) -> None:
        """Write a part."""
        for kind, table in zip(self.kinds, tables, strict=True):
            with replacing(self.file(part, kind)) as path:
                table.to_parquet(path, index=False)

    def read(self) -> pd.DataFrame:
        """Return a row per episode, seed by seed, once no part is missing."""
        return pd.concat([pd.read_parquet(self.file(part)) for part in self.parts])


Compute: TypeAlias = Callable[[Sweep, Sequence[int]], Iterator[tuple[int, Tables]]]
"""Computes parts and yields each with its rows, in any order."""


def run_sweep(sweep: Sweep, compute: Compute) -> Iterator[int]:
    """Compute the parts that are missing and write each when it is done, see `runner.run_parts`."""
    return run_parts(sweep, partial(compute, sweep))


def compute_here(sweep: Sweep, parts: Sequence[int], mesh: Mesh | None = None) -> Iterator[tuple[int, Tables]]:
    """Compute parts in this process, one on each device at a time; yield each with its rows.

    Args:
        sweep: which they are parts of.
        parts: their numbers.
        mesh: devices, see `ms_highway.loop.devices.device_mesh`; by default, the first device.
    """
    batch, together = make_batch(sweep.comparison, sweep.scenario), 1 if mesh is None else mesh.size
    for place in range(0, len(parts), together):
        shares = {part: sweep.keys(batch, part) for part in parts[place : place + together]}
        keys = [key for share in shares.values() for key in share]
        rows, first = batch.steps_table(keys, batch.simulate(keys, mesh)), 0
        for part, share in shares.items():
            steps = rows.iloc[first : first + len(share) * batch.steps]
            first += len(steps)
            yield part, [*([steps] if sweep.steps else []), batch.episodes_table(steps)]
