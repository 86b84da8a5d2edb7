"""Say in a few sentences what the numbers of a comparison show."""

import pandas as pd

from ms_highway.experiments.analysis.selection import choosing_controllers
from ms_highway.experiments.analysis.summary import interval


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
    if models.empty:
        models = rows.index
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
    return " ".join([*sentences, _collisions(rows)])


def _collisions(rows: pd.DataFrame) -> str:
    """Say with which controllers there are collisions, and in how many episodes."""
    hit = rows[rows["collision_episodes"] > 0]
    if hit.empty:
        return "No controller collides."
    episodes = [f"{name} in {row['collision_episodes']} of {row['episodes']}" for name, row in hit.iterrows()]
    return f"Episodes with a collision: {', '.join(episodes)}."
