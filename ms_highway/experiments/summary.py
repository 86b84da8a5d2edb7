"""Summarise records in a row per scenario and controller, with intervals, and in sentences."""

import numpy as np
import pandas as pd
from scipy import stats

from ms_highway.envs.registry import controller_config, priced_types
from ms_highway.experiments.records import models_of, per_episode

CONFIDENCE = 0.9
MILLISECONDS = {"planning_ms": "planning_seconds", "counted_ms": "counted_seconds", "decision_ms": "decision_seconds"}


def summary(records: pd.DataFrame) -> pd.DataFrame:
    """Return one row per scenario and controller, in the order of the records.

    Columns are ``kind``, the type of the controller, ``price``, its lambda, ``episodes``, their number, and:

    * per step: ``reward``, with ``reward_low`` and ``reward_high``, the 90 % interval of its mean over episodes
      (Student's t), and ``reward_std``, its standard deviation over episodes;
    * times per step: ``planning_ms`` and ``decision_ms`` as measured; ``counted_ms``, planning at the seconds T(M) that
      decisions count, empty if one is unknown; ``cycle_ms_p50`` and ``cycle_ms_p99``, quantiles of planning and
      deciding together;
    * shares of the steps: ``share_MODEL``, planned with a model; ``late``, driven with an old plan because the new one
      was late; ``way_out``, driven to keep a way out;
    * counts: ``collision_episodes``, in which the robot collided at least once; ``fallbacks``, steps of all episodes
      whose plan failed;
    * with several humans: ``success``, the share of the episodes in which the robot succeeded; ``humans_MODEL``, the
      mean number of humans that each rung above the first predicts.

    Args:
        records: a row per step, see `ms_highway.experiments.records.columns`; or a row per simulated episode, see
            `ms_highway.experiments.records.per_episode`, without measured times.

    Raises:
        ValueError: for an unknown controller.
    """
    table, by = per_episode(records) if "step" in records else records, ["scenario", "controller"]
    shares = [f"{what}_{name}" for what in ("share", "humans") for name in models_of(table, what)]
    shares += [name for name in ("success", "late", "way_out") if name in table]
    rows = []
    for (scenario, controller), some in table.groupby(by, sort=False):
        config, rewards = controller_config(controller), some["reward"]
        low, high = interval(rewards)
        row = {"scenario": scenario, "controller": controller}
        row |= {"kind": config["type"], "price": config.get("lambda", np.nan), "episodes": len(some)}
        row |= {"reward": rewards.mean(), "reward_low": low, "reward_high": high, "reward_std": rewards.std()}
        row |= {name: 1e3 * some[column].mean(skipna=False) for name, column in MILLISECONDS.items() if column in some}
        row |= {"collision_episodes": (some["collisions"] > 0).sum(), "fallbacks": some["fallbacks"].sum()}
        rows.append(row | dict(some[shares].mean()))
    summaries = pd.DataFrame(rows)
    if "planning_seconds" in records:
        cycles = records.assign(ms=1e3 * (records["planning_seconds"] + records["decision_seconds"])).groupby(by)["ms"]
        quantiles = pd.DataFrame({"cycle_ms_p50": cycles.quantile(0.5), "cycle_ms_p99": cycles.quantile(0.99)})
        summaries = summaries.join(quantiles, on=by)
    return summaries


def interval(values: pd.Series) -> tuple[float, float]:
    """Return the 90 % interval of the mean, by Student's t; NaN for fewer than two values."""
    half = stats.t.ppf((1 + CONFIDENCE) / 2, len(values) - 1) * values.sem()
    return values.mean() - half, values.mean() + half


def choosing_controllers(summaries: pd.DataFrame, scenario: str) -> list[str]:
    """Return one controller of each kind that chooses online, with the smallest lambda, in the table's order."""
    rows = summaries[(summaries["scenario"] == scenario) & summaries["kind"].isin(priced_types())]
    return rows.loc[rows.groupby("kind", sort=False)["price"].idxmin(), "controller"].to_list()


def most_informative_pair(summaries: pd.DataFrame, scenario: str) -> list[str]:
    """Return the two controllers of a scenario that are most informative side by side.

    These are the fixed model with the highest mean reward, and the first of `choosing_controllers`. If either is
    missing, the first of the other controllers replaces it, if there is another.
    """
    rows = summaries.query("scenario == @scenario")
    best = rows.query("kind == 'fixed'").nlargest(1, "reward")["controller"]
    return list(dict.fromkeys([*best, *choosing_controllers(summaries, scenario)[:1], *rows["controller"]]))[:2]


def answer(records: pd.DataFrame, summaries: pd.DataFrame, scenario: str) -> str:
    """Summarise a scenario: the gain of the best fixed model, the share that choosing keeps of it, and collisions.

    If no fixed model was driven, the best and the cheapest are those of all controllers. A gain is more than chance if
    its 90 % interval, over the starts from which both drove, is above 0.

    Args:
        records: a row per step, see `ms_highway.experiments.records.columns`.
        summaries: result of `summary`.
        scenario: name of the scenario.
    """
    rows = summaries.query("scenario == @scenario").set_index("controller")
    reward, counted = rows["reward"], rows["counted_ms"].fillna(float("inf"))
    models = rows.query("kind == 'fixed'").index
    models = rows.index if models.empty else models
    best, cheapest = str(reward[models].idxmax()), str(counted[models].idxmin())
    driven = records.query("scenario == @scenario").pivot_table("reward", "seed", "controller")
    gains = (driven[best] - driven[cheapest]).dropna()
    low, high = interval(gains)
    sentences = [f"{best} earns a reward of {reward[best]:.2f} per step."]
    if best != cheapest:
        chance = "" if low > 0 else ", which may be chance"
        sure = f"90 % interval {low:.2f} to {high:.2f}, starts: {len(gains)}" if len(gains) > 1 else "one start"
        sentences.append(f"That is {gains.mean():.2f} more than {cheapest} ({sure}){chance}.")
    for name in choosing_controllers(summaries, scenario):
        text, effort = f"{name} earns {reward[name]:.2f}", counted[name] / counted[best]
        if low > 0:
            text += f" and keeps {100 * (reward[name] - reward[cheapest]) / gains.mean():.0f} % of that gain"
        if effort < float("inf"):
            text += f", for {100 * effort:.0f} % of {best}'s planning"
        sentences.append(f"{text}.")
    hit = rows[rows["collision_episodes"] > 0]
    collisions = (f"{name} in {row['collision_episodes']} of {row['episodes']}" for name, row in hit.iterrows())
    last = "No controller collides" if hit.empty else f"Episodes with a collision: {', '.join(collisions)}"
    return " ".join([*sentences, f"{last}."])
