"""Keep results in a directory, with their settings and the runs that made them.

A run that was stopped resumes under the same settings.
"""

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
from typing import Annotated, Any, ClassVar, NotRequired, TypeAlias, TypedDict

import pandas as pd
from msgspec import Meta

from ms_highway.runtime.arrays import Positive, read
from ms_highway.runtime.files import (
    FILE_NAMES,
    locked,
    read_json,
    reading,
    replacing,
    tidy,
    write_json,
)
from ms_highway.runtime.jax_settings import cores
from ms_highway.runtime.sources import Sources, digest, package_digest

Count = Annotated[int, Meta(ge=0)]

AllSources: TypeAlias = dict[str, dict[str, Sources]]
"""Digests of what results depend on beside their settings, by scenario and controller.
"""


class Extended(TypedDict, total=False):
    """Keys of the settings that later comparisons in the same directory extend.

    All are by scenario.

    Attributes:
        measured: T(M) by model [s].
        asked: number of requested episodes, by controller.
        lengths: number of steps of an episode that nothing ends early.
        sources: see `AllSources`; controllers that depend on none are left out.
        late_sources: digests of what modules have imported and read while episodes were
            driven, by path.
    """

    measured: dict[str, dict[str, Positive]]
    asked: dict[str, dict[str, Count]]
    lengths: dict[str, Count]
    sources: AllSources
    late_sources: Sources


EXTENDED = tuple(Extended.__annotations__)
"""The keys of `Extended`."""

PACKAGES = ("ms-highway", "jax", "jaxlib", "highway-env", "gymnasium", "numpy")
"""Packages on whose versions results depend."""


class Run(TypedDict):
    """Description of a process that computed results.

    Attributes:
        command: that started it.
        time: UTC in ISO 8601.
        versions: by package.
        machine: ``processor``, ``cores`` that the process may use, and ``platform``.
        xla_flags: of JAX.
        code: digest of this package.
        commit: of a checkout.
        dirty: whether files of the checkout have changed since the commit.
    """

    command: str
    time: str
    versions: dict[str, str]
    machine: dict[str, Any]
    xla_flags: NotRequired[str]
    code: NotRequired[str]
    commit: NotRequired[str]
    dirty: NotRequired[bool]


@dataclass(frozen=True)
class ResultsDirectory:
    """A directory of results, which may not exist yet.

    An interrupted run is resumed under the same settings. Each piece of the results, an
    episode or a part of many, is either complete in the directory or computed again.
    """

    settings_file: ClassVar[str] = "settings.json"
    provenance_file: ClassVar[str] = "provenance.json"
    remedy: ClassVar[str] = "choose another directory with --out"

    path: Path

    @contextmanager
    def owned(self) -> Iterator["ResultsDirectory"]:
        """Lock the directory for this run while the block runs.

        Remove half-written files of earlier runs.

        Raises:
            ValueError: if another command is writing there, or the record of earlier
                runs cannot be read.
        """
        with locked(self.path):
            self.runs()
            tidy(self.path)
            yield self

    def settings(self) -> dict:
        """Return the settings of the results; empty without any.

        Raises:
            ValueError: if the file cannot be read.
        """
        file = self.path / self.settings_file
        if not file.exists():
            return {}
        with reading(file, "choose another directory"):
            settings = read(read_json(file), dict)
            read(settings, Extended)
        return settings

    def take_up(self, settings: Mapping, sources: AllSources) -> dict:
        """Return the settings to compute with.

        They are those of the results in the directory or, without results, these.

        Args:
            settings: of the new results.
            sources: what the new results depend on beside their settings.

        Raises:
            ValueError: if the directory holds results whose settings differ in more
                than `EXTENDED`, results of these scenarios and controllers that depend
                on other content, a record of runs that cannot be read, or other files.
        """
        known = self.settings()
        # Fail now if the record, to which this run will be added, cannot be read.
        self.runs()
        asked = json.loads(json.dumps(settings))
        if not known:
            self._refuse_other_files()
            known = asked
        differing = _differences(known, asked, "the default", EXTENDED)
        if differing:
            raise ValueError(
                f"{self.path} holds results with {differing}; {self.remedy}"
            )
        self._take_up_sources(known, sources)
        return known

    def _refuse_other_files(self) -> None:
        """Refuse a directory without settings that has files, except half-written ones.

        Raises:
            ValueError: if it has others.
        """
        if not self.path.exists():
            return
        if any(
            not file.name.startswith(FILE_NAMES.part) for file in self.path.iterdir()
        ):
            raise ValueError(
                f"{self.path} is not empty, and has no {self.settings_file};"
                f" {self.remedy}"
            )

    def _take_up_sources(self, known: dict, sources: AllSources) -> None:
        """Check the sources of known results; add those of new ones to the settings."""
        kept = known.get("sources", {})
        for scenario, controllers in sources.items():
            for controller, now in controllers.items():
                before = kept.get(scenario, {}).get(controller)
                if before is not None:
                    results = f"{self.path} holds results of {controller} in {scenario}"
                    refuse_changed(results, before, now, self.remedy)

        # All results of a directory stand in one table: a name has one content there,
        # also for other controllers.
        everything: Sources = {}
        for controllers in sources.values():
            for now in controllers.values():
                everything |= now
        for scenario, controllers in kept.items():
            for controller, before in controllers.items():
                common = {name: before[name] for name in before if name in everything}
                results = f"{self.path} holds results of {controller} in {scenario}"
                refuse_changed(results, common, everything, self.remedy)

        refuse_changed_files(f"{self.path} holds results", known, self.remedy)

        # Results that are there keep their sources, also if they depend on none.
        asked = known.get("asked", {})
        for scenario, controllers in sources.items():
            known_controllers = {*kept.get(scenario, {}), *asked.get(scenario, {})}
            for controller, now in controllers.items():
                if now and controller not in known_controllers:
                    own = known.setdefault("sources", {}).setdefault(scenario, {})
                    own[controller] = now

    def add_late_sources(self, settings: dict, late: Sources) -> None:
        """Add to the settings what modules have imported and read while they drove.

        Write the settings if that is new.

        Raises:
            ValueError: if a file has changed meanwhile.
        """
        if not late:
            return
        kept = settings.setdefault("late_sources", {})
        common = {name: content for name, content in kept.items() if name in late}
        refuse_changed(f"{self.path} holds results", common, late, self.remedy)
        if late.keys() - kept.keys():
            kept.update(late)
            self.write_settings(settings)

    def write_settings(self, settings: Mapping) -> None:
        """Write the settings of the results.

        Raises:
            OSError: if the file cannot be written.
        """
        write_json(self.path / self.settings_file, settings)

    def runs(self) -> list[Run]:
        """Return the recorded runs that made the results, the first one first.

        Raises:
            ValueError: if the record cannot be read.
        """
        file = self.path / self.provenance_file
        if not file.exists():
            return []
        remedy = "move it away or choose another directory"
        with reading(file, remedy, " as a list of runs"):
            return read(read_json(file), list[Run])

    def record(self, command: str) -> str:
        """Record this process as a further run, with the command that started it.

        Returns:
            The versions, flags and commit that differ from the last run; empty if none
            does.

        Raises:
            ValueError: if the record of earlier runs cannot be read.
        """
        run = this_run(command)
        runs = self.runs()
        differing = self.differing(run)
        write_json(self.path / self.provenance_file, [*runs, run])
        return differing

    def differing(self, run: Run) -> str:
        """Say in which software a run differs from the last recorded one.

        Software are versions, flags, code and commit; the text is empty without a
        difference.
        """
        runs = self.runs() or [run]
        last = runs[-1]
        # Earlier versions of this package recorded no code.
        if "code" not in last:
            run = {**run, "code": "none"}
        return _differences(_software(run), _software(last), "none")


def _software(run: Run) -> dict[str, str]:
    """Return what of a run may change results."""
    return {
        **run["versions"],
        "XLA_FLAGS": run.get("xla_flags") or "none",
        "code": run.get("code", "none"),
        "commit": run.get("commit", "none"),
    }


def _differences(
    one: Mapping,
    other: Mapping,
    absent: str,
    ignored: tuple[str, ...] = (),
) -> str:
    """Say what one mapping has instead of another one.

    Args:
        one: the first mapping.
        other: the second mapping.
        absent: word for the value of a key that is missing.
        ignored: keys that may differ.
    """
    differing = []
    for key in {**one, **other}:
        first = one.get(key, absent)
        second = other.get(key, absent)
        if key not in ignored and first != second:
            differing.append(f"{key} {first} instead of {second}")
    return ", ".join(differing)


def refuse_changed_files(what: str, settings: Mapping, remedy: str) -> None:
    """Refuse results after one of their ``late_sources`` has changed.

    See `refuse_changed`.
    """
    late = settings.get("late_sources", {})
    now = {}
    for name in late:
        file = Path(name)
        now[name] = digest(file) if file.is_file() else "missing"
    refuse_changed(what, late, now, remedy)


def refuse_changed(what: str, before: Sources, now: Sources, remedy: str) -> None:
    """Refuse to go on with results that were computed with other content of a file.

    Args:
        what: such as ``these are results of tom``.
        before: content that the results depend on.
        now: content of the same files now.
        remedy: what the user can do.

    Raises:
        ValueError: naming the file.
    """
    for name, content in before.items():
        if name not in now:
            raise ValueError(
                f"{what} that were computed with {name}, which is not imported now;"
                f" {remedy}"
            )
        if now[name] != content:
            raise ValueError(
                f"{what} that were computed before {name} changed; {remedy}"
            )


def write_table(table: pd.DataFrame, file: Path) -> None:
    """Write a table without its index, as ``.csv`` or ``.parquet``."""
    with replacing(file) as path:
        if file.suffix == ".parquet":
            table.to_parquet(path, index=False)
        else:
            table.to_csv(path, index=False)


def this_run(command: str = "") -> Run:
    """Describe this process, which a command started."""
    # The directory above the package has ``.git`` in a checkout.
    checkout = Path(__file__).parents[2]
    return {
        "command": command,
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in PACKAGES},
        },
        "machine": {
            "processor": _processor(),
            "cores": cores(),
            "platform": platform.platform(),
        },
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "code": package_digest(),
        **_commit(checkout),
    }


def _commit(directory: Path) -> dict:
    """Return the commit of a checkout, and whether files have changed since."""
    if not (directory / ".git").exists():
        return {}
    describe = "describe --always --dirty --abbrev=40 --exclude=*"
    command = ["git", "-C", str(directory), *describe.split()]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        # git is missing, or does not trust the directory's owner.
        return {}
    name = done.stdout.strip()
    return {"commit": name.removesuffix("-dirty"), "dirty": name.endswith("-dirty")}


def _processor() -> str:
    """Return the processor's name, which Python knows only on some systems."""
    information = Path("/proc/cpuinfo")
    text = information.read_text() if information.exists() else ""
    _, found, rest = text.partition("model name\t: ")
    if found:
        return rest.partition("\n")[0]
    return platform.processor() or platform.machine()
