"""Read and check a directory of results of ``ms-highway compare``."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from ms_highway.envs import ENVIRONMENTS
from ms_highway.experiments.analysis.published import PUBLISHED, PUBLISHED_WITH, Published
from ms_highway.experiments.analysis.summary import summary
from ms_highway.experiments.comparison import episode_steps
from ms_highway.experiments.provenance import read_runs
from ms_highway.experiments.records import check_columns, whole_steps
from ms_highway.experiments.runner import STEPS_FILE
from ms_highway.experiments.settings import EXTENDED, SETTINGS_FILE, read_settings
from ms_highway.planning.human_models import is_model, model_names

__all__ = ["Results", "read_results"]

UNKNOWN = "if it is your own, --import the module that adds it"
REMEDY = "name a directory that `ms-highway compare` wrote"


@dataclass(frozen=True)
class Results:
    """What a comparison has found.

    Attributes:
        directory: where it lies.
        records: a row per step.
        summaries: a row per scenario and controller, see `ms_highway.experiments.analysis.summary.summary`.
        settings: what the environments had in common, and T(M), see `ms_highway.experiments.settings.read_settings`.
        runs: what made it, see `ms_highway.experiments.provenance.this_run`; empty if that is not known.
    """

    directory: Path
    records: pd.DataFrame
    summaries: pd.DataFrame
    settings: dict[str, Any]
    runs: list[dict[str, Any]]

    @property
    def scenarios(self) -> list[str]:
        """Names of the scenarios, in the order of the records."""
        return list(dict.fromkeys(self.summaries["scenario"]))

    @property
    def missing(self) -> int:
        """The number of requested episodes that are not there yet."""
        rows = self.summaries.set_index(["scenario", "controller"])["episodes"]
        asked = self.settings.get("asked", {})
        return sum(
            max(0, seeds - int(rows.get((scenario, name), 0)))
            for scenario, controllers in asked.items()
            for name, seeds in controllers.items()
        )

    def published(self, scenario: str, controller: str) -> Published | None:
        """Return what the paper published of a controller, if these results may be compared with it."""
        chosen = {key: value for key, value in self.settings.items() if key not in EXTENDED and value is not None}
        return PUBLISHED.get((scenario, controller)) if chosen == PUBLISHED_WITH else None

    def config(self, scenario: str) -> dict[str, Any]:
        """Return the configuration that a scenario's environment had, but for the controller."""
        return {
            **common_config(self.settings),
            "costs": self.settings.get("measured", {}).get(scenario, self.settings["costs"]),
        }


def read_results(directory: Path) -> Results:
    """Read a directory of results.

    Raises:
        ValueError: if there is none, it lacks a file, or a file cannot be read or was left unfinished.
    """
    if not directory.is_dir():
        raise ValueError(f"there is no directory {directory}; {REMEDY}")
    for name in (STEPS_FILE, SETTINGS_FILE):
        if not (directory / name).is_file():
            raise ValueError(f"{directory} has no {name}; {REMEDY}")
    settings = read_settings(directory / SETTINGS_FILE)
    missing = {"semantics", "costs"} - settings.keys()
    if missing or not isinstance(settings.get("measured", {}), dict):
        raise ValueError(f"{directory / SETTINGS_FILE} holds no settings of a comparison; {REMEDY}")
    records = _read_records(directory / STEPS_FILE, common_config(settings))
    try:
        summaries = summary(records)
    except ValueError as error:
        raise ValueError(f"{directory / STEPS_FILE}: {error}; {UNKNOWN}") from error
    return Results(directory, records, summaries, settings, read_runs(directory))


def common_config(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Of the settings, the configuration that all environments had in common."""
    return {key: value for key, value in settings.items() if key not in ("costs", *EXTENDED)}


def _read_records(file: Path, config: Mapping[str, Any]) -> pd.DataFrame:
    try:
        records = pd.read_csv(file)
    except (OSError, ValueError) as error:
        raise ValueError(f"{file} cannot be read ({str(error).strip()}); {REMEDY}") from error
    try:
        check_columns(records)
    except ValueError as error:
        raise ValueError(f"{file} {error}; {REMEDY}") from error
    if records.empty:
        raise ValueError(f"{file} holds no episodes yet; let `ms-highway compare` finish one")
    for column, known, names in (
        ("scenario", ENVIRONMENTS.__contains__, ", ".join(ENVIRONMENTS)),
        ("model", is_model, model_names()),
    ):
        for name in records[column].dropna().unique():
            if not known(name):
                raise ValueError(f"{file} holds {column} {name!r}, not one of {names}; {UNKNOWN}")
    lengths = whole_steps(records)
    wanted = {name: episode_steps(name, config) for name in records["scenario"].unique()}
    whole = [length == wanted[scenario] for (scenario, *_), length in lengths.items()]
    if not all(whole) or lengths.sum() != len(records):
        raise ValueError(f"{file} holds an unfinished episode; run the same `ms-highway compare` again, which resumes")
    return records
