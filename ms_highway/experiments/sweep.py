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
from ms_highway.loop.records import Records
from ms_highway.runtime.files import reading, replacing

EPISODES, STEPS = "episodes", "steps"
"""Directories of a sweep's parts, with a row per episode and per step."""

Tables: TypeAlias = list[pd.DataFrame]
"""The rows of a part, in the order of `Sweep.files`."""


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

    def places(self, part: int) -> tuple[int, int]:
        """Return the first of a part's episodes among all, and the one after its last."""
        return part * self.part, min((part + 1) * self.part, self.episodes)

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

    def files(self, part: int) -> list[Path]:
        """Return the files of a part, that of its episodes last: when it is there, the part is done."""
        kinds = [STEPS, EPISODES] if self.steps else [EPISODES]
        return [self.directory / kind / f"part-{part:06d}.parquet" for kind in kinds]

    def missing(self) -> list[int]:
        """Return the parts that are not there yet.

        Raises:
            ValueError: for a file beside the parts that pandas would read with them.
        """
        there = {file for kind in (EPISODES, STEPS) for file in (self.directory / kind).glob("[!._]*")}
        parts = {part: self.files(part) for part in self.parts}
        if strangers := sorted(there.difference(*parts.values())):
            raise ValueError(f"{strangers[0]} is no part of this sweep, but would be read as one; move it away")
        return [part for part, files in parts.items() if not there.issuperset(files)]

    def read(self) -> pd.DataFrame:
        """Return a row per episode, seed by seed, once no part is missing."""
        return pd.concat([pd.read_parquet(self.files(part)[-1]) for part in self.parts])


Compute: TypeAlias = Callable[[Sweep, Sequence[int]], Iterator[tuple[int, Tables]]]
"""Computes parts and yields each with its rows, in any order."""


def run_sweep(sweep: Sweep, compute: Compute) -> Iterator[int]:
    """Compute the parts that are missing and write each when it is done.

    Yields:
        The number of episodes there: first of those that earlier runs have left, then after every part.

    Raises:
        ValueError: if the sweep is impossible, or a part that is there cannot be read or holds something else.
    """
    batch, missing = make_batch(sweep.comparison, sweep.scenario), sweep.missing()
    count, columns = 0, dict[str, list[str]]()
    for part in sorted({*sweep.parts} - {*missing}):
        _check(sweep, batch, part, columns)
        count += len(batch.keys(*sweep.places(part)))
    yield count
    for part, tables in compute(sweep, missing):
        for file, table in zip(sweep.files(part), tables, strict=True):
            with replacing(file) as path:
                table.to_parquet(path, index=False)
        count += len(tables[-1])
        yield count


def _check(sweep: Sweep, batch: Batch, part: int, columns: dict[str, list[str]]) -> None:
    """Check that the files of a part hold its episodes, in the same columns as other parts, by kind."""
    for file in sweep.files(part):
        steps = batch.steps if file.parent.name == STEPS else 1
        expected = [key for key in batch.keys(*sweep.places(part)) for _ in range(steps)]
        with reading(file, "remove it, to have it computed again"):
            rows = pd.read_parquet(file)
            if [*rows[["controller", "seed"]].itertuples(index=False, name=None)] != expected:
                raise ValueError("it holds other episodes than its number says")
            if list(rows) != columns.setdefault(file.parent.name, list(rows)):
                raise ValueError("its columns are not those of the parts before")
            check_numbers(rows)


def compute_here(sweep: Sweep, parts: Sequence[int], mesh: Mesh | None = None) -> Iterator[tuple[int, Tables]]:
    """Compute parts in this process, one on each device at a time; yield each with its rows.

    Args:
        sweep: which they are parts of.
        parts: their numbers.
        mesh: devices, see `ms_highway.loop.devices.device_mesh`; by default, the first device.
    """
    batch, together = make_batch(sweep.comparison, sweep.scenario), 1 if mesh is None else mesh.size
    for place in range(0, len(parts), together):
        now = parts[place : place + together]
        shares = [batch.keys(*sweep.places(part)) for part in now]
        records = batch.simulate([key for share in shares for key in share], mesh)
        first = 0
        for part, keys in zip(now, shares, strict=True):
            own = Records(*(column[first : first + len(keys)] for column in records))
            first += len(keys)
            steps = [batch.steps_table(keys, own)] if sweep.steps else []
            yield part, [*steps, batch.episodes_table(keys, own)]
