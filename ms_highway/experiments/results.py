"""Read and check a directory of results of ``ms-highway compare``, beside the results that the paper published."""

from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from ms_highway.experiments.directory import EXTENDED, SETTINGS_FILE, ResultsDirectory, Run
from ms_highway.experiments.runner import read_steps
from ms_highway.experiments.summary import summary

PUBLISHED_WITH = {
    "semantics": "released",
    "solver": "gradient",
    "human_reward": "published",
    "costs": "published",
}
"""Settings of a comparison that may be compared with the paper's; all others are the usual ones."""


ROWS = """\
stay_back  naive           -7.73  0.105
stay_back  turn             2.52  0.212
stay_back  switching:5      2.34  0.1165
stay_back  switching:0.4    2.59  0.1318
merger     naive            1.55  0.084
merger     turn             1.54  0.163
merger     tom              5.33  0.380
merger     switching:0.6    3.53  0.1294
merger     switching:0.1    5.54  0.1627
give_way   naive           -0.02  0.092
give_way   turn             0.34  0.181
give_way   tom              4.91  0.448
give_way   switching:0.03   1.78  0.1929
give_way   switching:0.01   4.44  0.2832"""

PUBLISHED = {
    (scenario, controller): (float(reward), float(seconds))
    for scenario, controller, reward, seconds in map(str.split, ROWS.splitlines())
}
"""By scenario and short name of the controller, means per step over 30 episodes: the robot's reward, and the seconds of
planning and deciding about the model.

From the logs that the authors of Sripathy, Bobu, Brown and Dragan, "Dynamically Switching Human Prediction Models for
Efficient Planning" (ICRA 2021), released; seconds are those of their laptop. The paper compared no others.
"""

REMEDY = "name a directory that `ms-highway compare` wrote; frontier, bench road and irl evaluate have no pages"


@dataclass(frozen=True)
class Results:
    """What a comparison has found.

    Attributes:
        directory: where it lies.
        records: a row per step.
        summaries: a row per scenario and controller, see `ms_highway.experiments.summary.summary`.
        settings: what the environments had in common, T(M), and the numbers of episodes that were asked for.
        runs: what made it; empty if that is not known.
    """

    directory: Path
    records: pd.DataFrame
    summaries: pd.DataFrame
    settings: dict
    runs: list[Run]

    @property
    def scenarios(self) -> list[str]:
        """Names of the scenarios, in the order of the records."""
        return list(dict.fromkeys(self.summaries["scenario"]))

    @property
    def missing(self) -> int:
        """The number of requested episodes that are not there yet."""
        asked = pd.DataFrame(self.settings["asked"]).unstack().dropna()
        there = self.summaries.set_index(["scenario", "controller"])["episodes"]
        return int((asked - there.reindex(asked.index, fill_value=0)).clip(lower=0).sum())

    @property
    def common(self) -> dict:
        """The part of the settings that configures all environments."""
        return {key: value for key, value in self.settings.items() if key not in EXTENDED and value is not None}

    def published(self, scenario: str, controller: str) -> tuple[float, float] | None:
        """Return what the paper published of a controller, if these results may be compared with it."""
        return PUBLISHED.get((scenario, controller)) if self.common == PUBLISHED_WITH else None

    def config(self, scenario: str) -> dict:
        """Return the configuration that a scenario's environment had, but for the controller."""
        measured = self.settings.get("measured", {})
        return self.common | ({"costs": measured[scenario]} if scenario in measured else {})


def read_results(directory: Path) -> Results:
    """Read a directory of results.

    Raises:
        ValueError: if it is none, or a file is missing or cannot be read.
    """
    results = ResultsDirectory(directory)
    settings = results.settings() if (directory / SETTINGS_FILE).is_file() else {}
    if "asked" not in settings:
        raise ValueError(f"{directory} holds no results of a comparison; {REMEDY}")
    records = read_steps(directory, settings)
    if records.empty:
        raise ValueError(f"{directory} holds no episodes yet; let `ms-highway compare` finish one")
    return Results(directory, records, summary(records), settings, results.runs())
