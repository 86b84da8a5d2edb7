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
from jax.sharding import Mesh
from pyarrow import parquet

from ms_highway.experiments.batch import Batch, make_batch
from ms_highway.experiments.comparison import Comparison, episode_steps
from ms_highway.experiments.directory import SETTINGS_FILE, ResultsDirectory
from ms_highway.runtime.files import reading, replacing
from ms_highway.simulation.records import Records

EPISODES, STEPS = "episodes", "steps"
"""Directories of a sweep's parts, with a row per episode and per step."""

PAUSE = 0.2  # s, between looks at what other processes have written


@dataclass(frozen=True)
class Sweep:
    """What is simulated, where it is kept, and which of several processes this is.

    Attributes:
        comparison: of a single scenario.
        directory: of the results.
        part: number of episodes in a part. There is one per device in memory, so that this grows with it, and not with
            the number of episodes.
        steps: whether a row per step is kept as well.
        place: number of this process, which computes every part k with ``k % processes == place``.
        processes: how many share the sweep.
    """

    comparison: Comparison
    directory: Path
    part: int = 1024
    steps: bool = False
    place: int = 0
    processes: int = 1

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
        """All parts."""
        return range(-(-self.episodes // self.part))

    @property
    def own(self) -> range:
        """The parts that this process computes."""
        return self.parts[self.place :: self.processes]

    def places(self, part: int) -> tuple[int, int]:
        """Return the first of a part's episodes among all, and the one after its last."""
        return part * self.part, (part + 1) * self.part

    def size(self, *parts: int) -> int:
        """Return the number of episodes in parts: in the last one, what is left."""
        return sum(min(self.part, self.episodes - part * self.part) for part in parts)

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

    def files(self, part: int) -> dict[Path, int]:
        """Return the files of a part, that of its episodes last, and how many rows they have."""
        name, size = f"part-{part:06d}.parquet", self.size(part)
        files = {self.directory / EPISODES / name: size}
        if not self.steps:
            return files
        return {self.directory / STEPS / name: size * episode_steps(self.scenario, self.comparison.config), **files}

    def missing(self) -> list[int]:
        """Return the parts that are not there yet, of any process."""
        there = {file for kind in (EPISODES, STEPS) for file in (self.directory / kind).glob("part-*")}
        return [part for part in self.parts if not there.issuperset(self.files(part))]


def run_sweep(sweep: Sweep, mesh: Mesh | None = None) -> Iterator[int]:
    """Compute this process's parts that are missing and write each when it is done.

    Args:
        sweep: what to compute.
        mesh: devices, each of which computes a part at a time; see `ms_highway.simulation.devices.device_mesh`.

    Yields:
        The number of this process's episodes there: first of those that earlier runs have left, then after every part.

    Raises:
        ValueError: if the sweep is impossible, or the directory holds a sweep of other settings, other results, or a
            part that cannot be read.
    """
    batch, results = make_batch(sweep.comparison, sweep.scenario), ResultsDirectory(sweep.directory)
    while sweep.place > 0 and not (sweep.directory / SETTINGS_FILE).exists():
        sleep(PAUSE)
    results.take_up(sweep.settings())
    lacking = sorted(set(sweep.own) & set(sweep.missing()))
    for part in sorted(set(sweep.own) - set(lacking)):
        for file, rows in sweep.files(part).items():
            with reading(file, "remove it, to have it computed again"):
                if (found := parquet.read_metadata(file).num_rows) != rows:
                    raise ValueError(f"it has {found} rows and should have {rows}")
                held = pd.read_parquet(file, columns=["controller", "seed"]).drop_duplicates()
                if [*held.itertuples(index=False, name=None)] != batch.keys(*sweep.places(part)):
                    raise ValueError("it holds other episodes than its number says")
    if sweep.place == 0:
        results.write_settings(sweep.settings())
    count, together = sweep.size(*sweep.own) - sweep.size(*lacking), 1 if mesh is None else mesh.size
    yield count
    for first in range(0, len(lacking), together):
        for part in _compute(sweep, batch, lacking[first : first + together], mesh):
            count += sweep.size(part)
            yield count


def _compute(sweep: Sweep, batch: Batch, parts: list[int], mesh: Mesh | None) -> Iterator[int]:
    """Compute parts, one on each device, and write them, the row per episode last: then the part is done."""
    shares = [batch.keys(*sweep.places(part)) for part in parts]
    records = batch.simulate([key for share in shares for key in share], mesh)
    first = 0
    for part, share in zip(parts, shares, strict=True):
        own = Records(*(column[first : first + len(share)] for column in records))
        first += len(share)
        *steps, episodes = sweep.files(part)
        for file, tabulate in [*((file, batch.steps_table) for file in steps), (episodes, batch.episodes_table)]:
            with replacing(file) as path:
                tabulate(share, own).to_parquet(path, index=False)
        yield part


def read_sweep(sweep: Sweep) -> pd.DataFrame:
    """Wait until all processes have written their parts; return a row per episode, seed by seed."""
    while sweep.missing():
        sleep(PAUSE)
    return pd.concat([pd.read_parquet([*sweep.files(part)][-1]) for part in sweep.parts])
