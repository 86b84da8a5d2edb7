"""Summarise records in tables and sentences; read a directory of results.

`PUBLISHED` holds the results of the paper.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

from ms_highway.envs.registry import controller_config, of_package, priced_types
from ms_highway.experiments.comparison import Comparison, models_of, per_episode
from ms_highway.experiments.directory import (
    EXTENDED,
    ResultsDirectory,
    Run,
    refuse_changed,
    refuse_changed_files,
)
from ms_highway.experiments.runner import read_steps

CONFIDENCE = 0.9
"""Probability of all intervals."""


def summary(records: pd.DataFrame) -> pd.DataFrame:
    """Return one row per scenario and controller, in the order of the records.

    Columns are ``kind``, the type of the controller, ``price``, its lambda,
    ``episodes``, their number, and:

    * per step: ``reward``, with ``reward_low`` and ``reward_high``, the 90 % interval
      of its mean over episodes (Student's t), and ``reward_std``, its standard
      deviation over episodes;
    * times per step: ``planning_ms`` and ``decision_ms`` as measured; ``counted_ms``,
      planning at the seconds T(M) that decisions count, empty if one is unknown;
      ``cycle_ms_p50`` and ``cycle_ms_p99``, quantiles of planning and deciding
      together;
    * shares of the steps: ``share_MODEL``, planned with a model; ``late``, driven with
      an old plan because the new one was late; ``way_out``, driven to keep a way out;
    * counts: ``collision_episodes``, in which the robot collided at least once;
      ``fallbacks``, steps of all episodes whose plan failed;
    * with several humans: ``success``, the share of the episodes in which the robot
      succeeded; ``humans_MODEL``, the mean number of humans that each rung above the
      first predicts.

    Args:
        records: a row per step, see
            `ms_highway.experiments.comparison.Comparison.columns`; or a row per
            simulated episode, see `ms_highway.experiments.comparison.per_episode`,
            without measured times.

    Raises:
        ValueError: for an unknown controller.
    """
    episodes = per_episode(records) if "step" in records else records
    shares = [f"share_{name}" for name in models_of(episodes, "share")]
    shares += [f"humans_{name}" for name in models_of(episodes, "humans")]
    shares += [name for name in ("success", "late", "way_out") if name in episodes]
    times = [
        name
        for name in ("planning", "counted", "decision")
        if f"{name}_seconds" in episodes
    ]

    by = ["scenario", "controller"]
    rows = []
    for (scenario, controller), own in episodes.groupby(by, sort=False):
        config = controller_config(controller)
        rewards = own["reward"]
        low, high = interval(rewards)
        row = {
            "scenario": scenario,
            "controller": controller,
            "kind": config["type"],
            "price": config.get("lambda", np.nan),
            "episodes": len(own),
            "reward": rewards.mean(),
            "reward_low": low,
            "reward_high": high,
            "reward_std": rewards.std(),
        }
        for name in times:
            row[f"{name}_ms"] = 1e3 * own[f"{name}_seconds"].mean(skipna=False)
        row["collision_episodes"] = (own["collisions"] > 0).sum()
        row["fallbacks"] = own["fallbacks"].sum()
        rows.append(row | dict(own[shares].mean()))
    summaries = pd.DataFrame(rows)
    if "planning_seconds" not in records:
        return summaries

    # Quantiles of the time of single steps.
    seconds = records["planning_seconds"] + records["decision_seconds"]
    cycles = records.assign(ms=1e3 * seconds).groupby(by)["ms"]
    quantiles = {
        "cycle_ms_p50": cycles.quantile(0.5),
        "cycle_ms_p99": cycles.quantile(0.99),
    }
    return summaries.join(pd.DataFrame(quantiles), on=by)


def interval(values: pd.Series) -> tuple[float, float]:
    """Return the 90 % interval of the mean, by Student's t.

    It is NaN for fewer than two values.
    """
    half = stats.t.ppf((1 + CONFIDENCE) / 2, len(values) - 1) * values.sem()
    return values.mean() - half, values.mean() + half


def choosing_controllers(summaries: pd.DataFrame, scenario: str) -> list[str]:
    """Return a controller of each kind that chooses online, with the smallest lambda.

    They are in the table's order.
    """
    here = summaries["scenario"] == scenario
    rows = summaries[here & summaries["kind"].isin(priced_types())]
    smallest = rows.groupby("kind", sort=False)["price"].idxmin()
    return rows.loc[smallest, "controller"].to_list()


def most_informative_pair(
    summaries: pd.DataFrame,
    scenario: str,
    own: bool = True,
) -> list[str]:
    """Return the two controllers of a scenario that are most informative side by side.

    These are the fixed model with the highest mean reward, and the first of
    `choosing_controllers`. If either is missing, the first of the other controllers
    replaces it, if there is another.

    Args:
        summaries: result of `summary`.
        scenario: name of the scenario.
        own: whether controllers count that run code from elsewhere, see
            `ms_highway.envs.registry.of_package`.
    """
    rows = summaries.query("scenario == @scenario")
    if not own:
        rows = rows[[of_package(name) for name in rows["controller"]]]
    best = rows.query("kind == 'fixed'").nlargest(1, "reward")["controller"]
    choosing = choosing_controllers(rows, scenario)[:1]
    return list(dict.fromkeys([*best, *choosing, *rows["controller"]]))[:2]


def answer(records: pd.DataFrame, summaries: pd.DataFrame, scenario: str) -> str:
    """Summarise a scenario in sentences.

    They tell the gain of the best fixed model over the cheapest one, the share that
    choosing keeps of it, and collisions. If no fixed model was driven, the best and the
    cheapest are those of all controllers. A gain is more than chance if its 90 %
    interval, over the starts from which both drove, is above 0.

    Args:
        records: a row per step, see
            `ms_highway.experiments.comparison.Comparison.columns`.
        summaries: result of `summary`.
        scenario: name of the scenario.
    """
    rows = summaries.query("scenario == @scenario").set_index("controller")
    reward = rows["reward"]
    # A controller whose T(M) is unknown is never the cheapest.
    counted = rows["counted_ms"].fillna(float("inf"))
    fixed = rows.query("kind == 'fixed'").index
    models = rows.index if fixed.empty else fixed
    best = str(reward[models].idxmax())
    cheapest = str(counted[models].idxmin())

    # The gain from each start from which both drove.
    driven = records.query("scenario == @scenario")
    by_start = driven.pivot_table("reward", "seed", "controller")
    gains = (by_start[best] - by_start[cheapest]).dropna()
    low, high = interval(gains)

    sentences = [f"{best} earns a reward of {reward[best]:.2f} per step."]
    if best != cheapest:
        starts = "one start"
        if len(gains) > 1:
            starts = f"90 % interval {low:.2f} to {high:.2f}, starts: {len(gains)}"
        chance = "" if low > 0 else ", which may be chance"
        more = f"{gains.mean():.2f} more than {cheapest}"
        sentences.append(f"That is {more} ({starts}){chance}.")
    for name in choosing_controllers(summaries, scenario):
        sentence = f"{name} earns {reward[name]:.2f}"
        if low > 0:
            kept = 100 * (reward[name] - reward[cheapest]) / gains.mean()
            sentence += f" and keeps {kept:.0f} % of that gain"
        effort = counted[name] / counted[best]
        if effort < float("inf"):
            sentence += f", for {100 * effort:.0f} % of {best}'s planning"
        sentences.append(f"{sentence}.")

    hit = rows[rows["collision_episodes"] > 0]
    if hit.empty:
        sentences.append("No controller collides.")
    else:
        collisions = ", ".join(
            f"{name} in {row['collision_episodes']} of {row['episodes']}"
            for name, row in hit.iterrows()
        )
        sentences.append(f"Episodes with a collision: {collisions}.")
    return " ".join(sentences)


PUBLISHED = {
    ("stay_back", "naive"): (-7.73, 0.105),
    ("stay_back", "turn"): (2.52, 0.212),
    ("stay_back", "switching:5"): (2.34, 0.1165),
    ("stay_back", "switching:0.4"): (2.59, 0.1318),
    ("merger", "naive"): (1.55, 0.084),
    ("merger", "turn"): (1.54, 0.163),
    ("merger", "tom"): (5.33, 0.380),
    ("merger", "switching:0.6"): (3.53, 0.1294),
    ("merger", "switching:0.1"): (5.54, 0.1627),
    ("give_way", "naive"): (-0.02, 0.092),
    ("give_way", "turn"): (0.34, 0.181),
    ("give_way", "tom"): (4.91, 0.448),
    ("give_way", "switching:0.03"): (1.78, 0.1929),
    ("give_way", "switching:0.01"): (4.44, 0.2832),
}
"""Published results by scenario and short name of the controller: means per step over
30 episodes of the robot's reward, and of the seconds of planning and deciding.

They are from the logs that the authors of Sripathy, Bobu, Brown and Dragan,
"Dynamically Switching Human Prediction Models for Efficient Planning" (ICRA 2021),
released. The seconds were measured on their laptop. The paper compared no other
controllers.
"""


@dataclass(frozen=True)
class Results:
    """Results of a comparison.

    Attributes:
        records: a row per step.
        summaries: a row per scenario and controller, see
            `ms_highway.experiments.summary.summary`.
        settings: common configuration of the environments, T(M), and the numbers of
            requested episodes.
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
        there = self.summaries.set_index(["scenario", "controller"])["episodes"]
        missing = 0
        for scenario, controllers in self.settings["asked"].items():
            for name, count in controllers.items():
                missing += max(count - there.get((scenario, name), 0), 0)
        return missing

    @property
    def common(self) -> dict:
        """The part of the settings that configures all environments."""
        return {
            key: value
            for key, value in self.settings.items()
            if key not in EXTENDED and value is not None
        }

    def published(self, scenario: str, controller: str) -> tuple[float, float] | None:
        """Return the published results of a controller.

        They are None if these results may not be compared with them.
        """
        # Settings of the paper; all other settings have to be the defaults.
        of_the_paper = {
            "semantics": "released",
            "solver": "gradient",
            "human_reward": "published",
            "costs": "published",
        }
        if self.common != of_the_paper:
            return None
        return PUBLISHED.get((scenario, controller))

    def config(self, scenario: str) -> dict:
        """Return the configuration of a scenario's environment without a controller."""
        config = self.common
        measured = self.settings.get("measured", {})
        if scenario in measured:
            config["costs"] = measured[scenario]
        return config

    def refuse_changed(self, scenario: str, controllers: Sequence[str]) -> None:
        """Refuse to drive controllers that cannot be driven as in these results.

        Raises:
            ValueError: naming what is missing or has changed.
        """
        remedy = "add --no-videos"
        refuse_changed_files("these are results", self.settings, remedy)
        before = self.settings.get("sources", {}).get(scenario, {})
        try:
            asked = Comparison({scenario: controllers}, config=self.config(scenario))
            now = asked.sources()[scenario]
        except ValueError as error:
            needed = "import what these results need with --import, or add --no-videos"
            raise ValueError(
                f"{scenario} cannot be filmed ({error}); {needed}"
            ) from error
        for name in controllers:
            what = f"these are results of {name} in {scenario}"
            refuse_changed(what, before.get(name, {}), now[name], remedy)


def read_results(directory: Path) -> Results:
    """Read a directory of results.

    Raises:
        ValueError: if it is no such directory, or a file is missing or cannot be read.
    """
    directory_of_results = ResultsDirectory(directory)
    settings = directory_of_results.settings()
    if "asked" not in settings:
        raise ValueError(
            f"{directory} holds no results of a comparison; name a directory that"
            " `ms-highway compare` wrote; frontier, bench road and irl evaluate have no"
            " pages"
        )
    records = read_steps(directory, settings)
    if records.empty:
        raise ValueError(
            f"{directory} holds no whole episodes yet; let `ms-highway compare`"
            " finish one"
        )
    return Results(records, summary(records), settings, directory_of_results.runs())
