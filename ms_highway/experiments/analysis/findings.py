"""Say in a few sentences what the numbers of a comparison show."""

import pandas as pd

from ms_highway.experiments.analysis.selection import choosing_controllers
from ms_highway.experiments.analysis.summary import interval


def answer(records: pd.DataFrame, summaries: pd.DataFrame, scenario: str) -> str:
    """Say what the best fixed model gains over the cheapest, how much of it choosing keeps, and what collides.

    A gain counts as more than chance by its 90 % interval over the starts that both drove from.

    Args:
        records: a row per step, see `ms_highway.experiments.records.columns`.
        summaries: of `ms_highway.experiments.analysis.summary.summary`.
        scenario: its name.
    """
    rows = summaries.query("scenario == @scenario").set_index("controller")
    reward, counted, fixed = rows["reward"], rows["counted_ms"], rows.query("kind == 'fixed'")
    choosing = choosing_controllers(summaries, scenario)
    if fixed.empty:
        best = str(reward.idxmax())
        return f"{best} earns the most, a reward of {reward[best]:.2f} per step. {_collisions(rows)}"
    best, cheapest = str(fixed["reward"].idxmax()), str(fixed["counted_ms"].fillna(float("inf")).idxmin())
    driven = records.query("scenario == @scenario").pivot_table("reward", "seed", "controller")
    gains = (driven[best] - driven[cheapest]).dropna()
    low, high = interval(gains)
    sure = f"90 % interval {low:.2f} to {high:.2f}, {len(gains)} starts"
    if best == cheapest:
        text = "and no more expensive fixed model earns more"
    elif low > 0:
        text = f"{gains.mean():.2f} more than {cheapest} ({sure})"
    elif len(gains) < 2:
        text = f"{cheapest} {reward[cheapest]:.2f}; one start cannot show a difference"
    else:
        text = f"{cheapest} {reward[cheapest]:.2f}; these starts do not show a difference ({sure})"
    sentences = [f"{best} earns a reward of {reward[best]:.2f} per step, {text}."]
    for name in choosing:
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
