"""Simulate very many episodes, kept in parts that need not fit in memory, so that an interrupted run can be resumed.

A part is a Parquet file: small, typed, and read by ``pandas.read_parquet`` alone or with its whole directory. It is
written under another name and moved to its own when it is whole, so that every part is either whole or not there.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import pandas as pd
from jax.sharding import Mesh

from ms_highway.experiments.batch import Batch, make_batch
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.records import check_numbers
from ms_highway.runtime.files import reading, replacing

EPISODES, STEPS = "episodes", "steps"
"""Directories of a sweep's parts, with a row per episode and per step."""

Tables: TypeAlias = dict[str, pd.DataFrame]
"""The rows of a part by directory, those of its episodes last: when they are there, the part is done."""


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

    def batch(self) -> Batch:
        """Return the batch of episodes to simulate.

        Raises:
            ValueError: if it cannot be simulated.
        """
        return make_batch(self.comparison, self.scenario)

    def places(self, part: int) -> tuple[int, int]:
        """Return the first of a part's episodes among all, and the one after its last."""
        return part * self.part, min((part + 1) * self.part, self.episodes)

    def file(self, part: int, kind: str = EPISODES) -> Path:
        """Return the file of a part's rows."""
        return self.directory / kind / f"part-{part:06d}.parquet"

    def missing(self) -> dict[int, int]:
        """Return the parts that are not there yet, and how many episodes each has.

        Raises:
            ValueError: if the sweep cannot be simulated, or as `read`.
        """
        kinds = [STEPS, EPISODES] if self.steps else [EPISODES]
        there = [part for part in self.parts if all(self.file(part, kind).exists() for kind in kinds)]
        self.read(there)
        places = {part: self.places(part) for part in sorted({*self.parts} - {*there})}
        return {part: last - first for part, (first, last) in places.items()}

    def read(self, parts: Sequence[int] | None = None) -> pd.DataFrame:
        """Return a row per episode of parts that are there, by default of all, seed by seed.

        Raises:
            ValueError: for a part that cannot be read, or holds something else.
        """
        batch, tables = self.batch(), [pd.DataFrame()]
        for part in self.parts if parts is None else parts:
            with reading(self.file(part), "remove it, to have it computed again"):
                tables.append(rows := pd.read_parquet(self.file(part)))
                if list(rows) != list(tables[1]):
                    raise ValueError("its columns are not those of the parts before")
                if [*zip(rows["controller"], rows["seed"], strict=True)] != batch.keys(*self.places(part)):
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
        ValueError: if what is there cannot be read, or is of other settings.
    """
    missing = sweep.missing()
    number = sweep.episodes - sum(missing.values())
    yield number
    for part, tables in compute(sweep, list(missing)):
        for kind, table in tables.items():
            with replacing(sweep.file(part, kind)) as path:
                table.to_parquet(path, index=False)
        number += missing[part]
        yield number


def compute_here(sweep: Sweep, parts: Sequence[int], mesh: Mesh | None = None) -> Iterator[tuple[int, Tables]]:
    """Compute parts in this process, one on each device at a time; yield each with its rows.

    Args:
        sweep: which they are parts of.
        parts: their numbers.
        mesh: devices, see `ms_highway.loop.devices.device_mesh`; by default, the first device.
    """
    batch, together = sweep.batch(), 1 if mesh is None else mesh.size
    for place in range(0, len(parts), together):
        shares = {part: batch.keys(*sweep.places(part)) for part in parts[place : place + together]}
        keys = [key for share in shares.values() for key in share]
        steps = batch.steps_table(keys, batch.simulate(keys, mesh))
        for part, share in shares.items():
            own, steps = steps[: len(share) * batch.steps], steps[len(share) * batch.steps :]
            yield part, {**({STEPS: own} if sweep.steps else {}), EPISODES: batch.episodes_table(own)}
