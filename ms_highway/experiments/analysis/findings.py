"""Say in a few sentences what the numbers of a comparison show, and select what else is shown of it."""

import pandas as pd

from ms_highway.envs.registry import priced_types
from ms_highway.experiments.analysis.summary import interval


def choosing_controllers(summaries: pd.DataFrame, scenario: str) -> list[str]:
    """Return a controller of each kind that chooses online, the one at the smallest lambda, in the table's order."""
    rows = summaries[(summaries["scenario"] == scenario) & summaries["kind"].isin(priced_types())]
    return rows.loc[rows.groupby("kind", sort=False)["price"].idxmin(), "controller"].to_list()


def most_informative_pair(summaries: pd.DataFrame, scenario: str) -> list[str]:
    """Return the two controllers of a scenario that are most informative side by side.

    These are the fixed model of the highest mean reward, and the first of `choosing_controllers`; where either is
    missing, the first of the others; the only one where there is one.
    """
    rows = summaries.query("scenario == @scenario")
    best = rows.query("kind == 'fixed'").nlargest(1, "reward")["controller"]
    return list(dict.fromkeys([*best, *choosing_controllers(summaries, scenario)[:1], *rows["controller"]]))[:2]


def answer(records: pd.DataFrame, summaries: pd.DataFrame, scenario: str) -> str:
    """Say what the best fixed model gains over the cheapest, how much of it choosing keeps, and what collides.

    Where no fixed model was driven, the best and the cheapest are those of all controllers.
    A gain counts as more than chance by its 90 % interval over the starts that both drove from.

    Args:
        records: a row per step, see `ms_highway.experiments.records.columns`.
        summaries: of `ms_highway.experiments.analysis.summary.summary`.
        scenario: its name.
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
