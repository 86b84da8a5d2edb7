"""Read and check a directory of results of ``ms-highway compare``, and tell the results that the paper published."""

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
"""Settings under which results may be compared with the paper's; all other settings are the defaults."""


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
"""Published results by scenario and short name of the controller: means per step over 30 episodes of the robot's
reward, and of the seconds of planning and deciding.

They are from the logs that the authors of Sripathy, Bobu, Brown and Dragan, "Dynamically Switching Human Prediction
Models for Efficient Planning" (ICRA 2021), released. The seconds were measured on their laptop. The paper compared no
other controllers.
"""

REMEDY = "name a directory that `ms-highway compare` wrote; frontier, bench road and irl evaluate have no pages"


@dataclass(frozen=True)
class Results:
    """Results of a comparison.

    Attributes:
        records: a row per step.
        summaries: a row per scenario and controller, see `ms_highway.experiments.summary.summary`.
        settings: common configuration of the environments, T(M), and the numbers of requested episodes.
        runs: runs that made the results; empty if they are not recorded.
    """

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
        """The number of requested episodes that are missing."""
        asked = pd.DataFrame(self.settings["asked"]).unstack().dropna()
        there = self.summaries.set_index(["scenario", "controller"])["episodes"]
        return int((asked - there.reindex(asked.index, fill_value=0)).clip(lower=0).sum())

    @property
    def common(self) -> dict:
        """The part of the settings that configures all environments."""
        return {key: value for key, value in self.settings.items() if key not in EXTENDED and value is not None}

    def published(self, scenario: str, controller: str) -> tuple[float, float] | None:
        """Return the published results of a controller, if these results may be compared with them."""
        return PUBLISHED.get((scenario, controller)) if self.common == PUBLISHED_WITH else None

    def config(self, scenario: str) -> dict:
        """Return the configuration of a scenario's environment, without the controller."""
        measured = self.settings.get("measured", {})
        return self.common | ({"costs": measured[scenario]} if scenario in measured else {})


def read_results(directory: Path) -> Results:
    """Read a directory of results.

    Raises:
        ValueError: if it is no such directory, or a file is missing or cannot be read.
    """
    results = ResultsDirectory(directory)
    settings = results.settings() if (directory / SETTINGS_FILE).is_file() else {}
    if "asked" not in settings:
        raise ValueError(f"{directory} holds no results of a comparison; {REMEDY}")
    records = read_steps(directory, settings)
    if records.empty:
        raise ValueError(f"{directory} holds no episodes yet; let `ms-highway compare` finish one")
    return Results(records, summary(records), settings, results.runs())
