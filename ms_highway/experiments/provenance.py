"""Record what made a directory of results: the command, the versions, the machine and the time of every run."""

import json
import os
import platform
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from ms_highway.runtime.files import read_json, replacing
from ms_highway.runtime.jax_settings import cores

__all__ = ["PROVENANCE_FILE", "add_run", "differing_versions", "read_runs", "this_run"]

PROVENANCE_FILE = "provenance.json"
PACKAGES = ("ms-highway", "jax", "jaxlib", "highway-env", "gymnasium", "numpy")
KEYS = {"command": str, "time": str, "versions": dict, "machine": dict}


def this_run(command: str) -> dict[str, Any]:
    """Describe this process.

    Args:
        command: the line that started it.

    Returns:
        ``command``; ``time``, UTC in ISO 8601; ``versions`` of Python and of the packages that results depend on;
        ``machine``: ``processor``, ``cores`` that the process may use, and ``platform``; ``xla_flags``, which XLA
        compiles by.
    """
    return {
        "command": command,
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}},
        "machine": {"processor": _processor(), "cores": cores(), "platform": platform.platform()},
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }


def read_runs(directory: Path) -> list[dict[str, Any]]:
    """Return the runs that made a directory's results, the first one first; none where nothing is recorded.

    Raises:
        ValueError: if the record cannot be read.
    """
    file = directory / PROVENANCE_FILE
    if not file.exists():
        return []
    try:
        runs = read_json(file)
    except (OSError, ValueError) as error:
        raise ValueError(f"{file} cannot be read ({error}); move it away or choose another directory") from error
    if not isinstance(runs, list) or not all(_is_run(run) for run in runs):
        raise ValueError(f"{file} is no list of runs; move it away or choose another directory")
    return runs


def add_run(directory: Path, run: dict[str, Any]) -> None:
    """Record one more run in a directory, after those that it has.

    Raises:
        ValueError: if those cannot be read.
    """
    runs = [*read_runs(directory), run]
    with replacing(directory / PROVENANCE_FILE) as path:
        path.write_text(json.dumps(runs, indent=2) + "\n")


def differing_versions(directory: Path, run: dict[str, Any]) -> str:
    """Say in which versions and flags a run differs from the last one of a directory; empty if in none.

    Raises:
        ValueError: if the runs before cannot be read.
    """
    runs = read_runs(directory)
    if not runs:
        return ""
    before, now = ({**one["versions"], "XLA_FLAGS": one.get("xla_flags", "")} for one in (runs[-1], run))
    differing = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    return ", ".join(f"{name} {now.get(name) or 'none'} instead of {before.get(name) or 'none'}" for name in differing)


def _is_run(run: Any) -> bool:
    return isinstance(run, dict) and all(isinstance(run.get(key), kind) for key, kind in KEYS.items())


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _processor() -> str:
    """Return the processor's name, which Python knows only on some systems."""
    information = Path("/proc/cpuinfo")
    lines = information.read_text().splitlines() if information.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
