"""Keep results in a directory, with the settings under which they are resumed and the runs that made them."""

import json
import os
import platform
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import TypeAlias

import msgspec
import pandas as pd

from ms_highway.runtime.files import PART, held, read_json, reading, replacing, tidy, write_json
from ms_highway.runtime.jax_settings import cores

SETTINGS_FILE, PROVENANCE_FILE = "settings.json", "provenance.json"
EXTENDED = ("measured", "asked")
"""Keys of the settings that later comparisons in the same directory extend: T(M), and numbers of episodes."""

CHECKOUT = Path(__file__).parents[2]
"""Directory above the package, which has ``.git`` in a checkout."""

PACKAGES = ("ms-highway", "jax", "jaxlib", "highway-env", "gymnasium", "numpy")

Run: TypeAlias = dict
"""Description of a process that computed results, see `this_run`."""


@dataclass(frozen=True)
class ResultsDirectory:
    """A directory of results, which may not exist yet.

    An interrupted run is resumed under the same settings. Each piece of the results, an episode or a part of many, is
    either complete in the directory or computed again.
    """

    path: Path

    @contextmanager
    def owned(self) -> Iterator["ResultsDirectory"]:
        """Lock the directory for this run while the block runs, and remove half-written files of earlier runs.

        Raises:
            ValueError: if another command is writing there, or the record of earlier runs cannot be read.
        """
        with held(self.path):
            self.runs()
            tidy(self.path)
            yield self

    def settings(self) -> dict:
        """Return the settings of the results; empty without any.

        Raises:
            ValueError: if the file cannot be read.
        """
        file = self.path / SETTINGS_FILE
        with reading(file, "choose another directory"):
            return msgspec.convert(read_json(file), dict) if file.exists() else {}

    def take_up(self, settings: Mapping) -> dict:
        """Return the settings to compute with: those of the results in the directory or, without results, these.

        Raises:
            ValueError: if the directory holds results whose settings differ in more than `EXTENDED`, or other files.
        """
        remedy = "choose another directory with --out"
        known, wanted = self.settings(), json.loads(json.dumps(settings))
        if not known:
            if self.path.exists() and any(not file.name.startswith(PART) for file in self.path.iterdir()):
                raise ValueError(f"{self.path} is not empty, and has no {SETTINGS_FILE}; {remedy}")
            return wanted
        differing = _differences(known, wanted, "the default", EXTENDED)
        if differing:
            raise ValueError(f"{self.path} holds results with {differing}; {remedy}")
        return known

    def write_settings(self, settings: Mapping) -> None:
        """Write the settings of the results.

        Raises:
            OSError: if the file cannot be written.
        """
        write_json(self.path / SETTINGS_FILE, settings)

    def runs(self) -> list[Run]:
        """Return the recorded runs that made the results, the first one first.

        Raises:
            ValueError: if the record cannot be read.
        """
        file = self.path / PROVENANCE_FILE
        with reading(file, "move it away or choose another directory", " as a list of runs"):
            return msgspec.convert(read_json(file), list[Run]) if file.exists() else []

    def record(self, command: str) -> str:
        """Record this process as a further run, with the command that started it.

        Returns:
            The versions, flags and commit that differ from the last run; empty if none does.

        Raises:
            ValueError: if the record of earlier runs cannot be read.
        """
        runs = [*self.runs(), this_run(command)]
        write_json(self.path / PROVENANCE_FILE, runs)
        before, now = (
            {**run["versions"], "XLA_FLAGS": run.get("xla_flags") or "none", "commit": run.get("commit", "none")}
            for run in (runs[-2:][0], runs[-1])
        )
        return _differences(now, before, "none")


def _differences(one: Mapping, other: Mapping, absent: str, but: tuple[str, ...] = ()) -> str:
    """Say in which keys two mappings differ, and what the first one has instead of the second."""
    pairs = {key: (one.get(key, absent), other.get(key, absent)) for key in {**one, **other} if key not in but}
    return ", ".join(f"{key} {mine} instead of {yours}" for key, (mine, yours) in pairs.items() if mine != yours)


def write_table(table: pd.DataFrame, file: Path) -> None:
    """Write a table without its index, in the format of the file's ending: ``.csv`` or ``.parquet``."""
    with replacing(file) as path:
        if file.suffix == ".parquet":
            table.to_parquet(path, index=False)
        else:
            table.to_csv(path, index=False)


def this_run(command: str = "") -> Run:
    """Describe this process, which a command started.

    Returns:
        ``command``; ``time``, UTC in ISO 8601; ``versions`` by package; ``machine`` with its ``processor``, ``cores``
        that the process may use, and ``platform``; ``xla_flags``; and in a checkout, its ``commit``, and ``dirty``:
        whether files have changed since.
    """
    return {
        "command": command,
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}},
        "machine": {"processor": _processor(), "cores": cores(), "platform": platform.platform()},
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        **_checkout(CHECKOUT),
    }


def _checkout(directory: Path) -> dict:
    if not (directory / ".git").exists():
        return {}
    command = ["git", "-C", str(directory), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        told = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):  # git is missing, or does not trust the directory's owner
        return {}
    return {"commit": told.removesuffix("-dirty"), "dirty": told.endswith("-dirty")}


def _processor() -> str:
    """Return the processor's name, which Python knows only on some systems."""
    information = Path("/proc/cpuinfo")
    text = information.read_text() if information.exists() else ""
    _, found, name = text.partition("model name\t: ")
    return name.partition("\n")[0] if found else platform.processor() or platform.machine()
