"""Say in a few sentences what the numbers of a comparison show."""

from collections.abc import Iterable

import pandas as pd

from ms_highway.experiments.analysis.selection import choosing_controllers, telling_pair
from ms_highway.experiments.analysis.summary import interval

FIRST = "merger", "give_way"


def answer(records: pd.DataFrame, summaries: pd.DataFrame, scenario: str) -> str:
    """Say what the best fixed model gains over the cheapest, how much of it choosing keeps, and who collides.

    A gain counts as more than chance by its 90 % interval over the starts that both drove from.

    Args:
        records: a row per step, see `ms_highway.experiments.records.columns`.
        summaries: of `ms_highway.experiments.analysis.summary.summary`.
        scenario: its name.
    """
    rows = summaries.query("scenario == @scenario").set_index("controller")
    reward, counted, fixed = rows["reward"], rows["counted_ms"], rows.query("kind == 'fixed'")
    if fixed.empty:
        pair = telling_pair(summaries, scenario)
        return " ".join(
            [*(f"{name} earns a reward of {reward[name]:.2f} per step." for name in pair), _collisions(rows)]
        )
    best, cheapest = str(fixed["reward"].idxmax()), str(fixed["counted_ms"].fillna(float("inf")).idxmin())
    driven = records.query("scenario == @scenario").pivot_table("reward", "seed", "controller")
    gains = (driven[best] - driven[cheapest]).dropna()
    low, high = interval(gains)
    choosing = choosing_controllers(summaries, scenario)
    if low > 0 and choosing:
        kept, effort = 100 * (reward - reward[cheapest]) / gains.mean(), 100 * counted / counted[best]
        shares = [
            f"{name} keeps {kept[name]:.0f} % of {best}'s gain over {cheapest}"
            + (f" for {effort[name]:.0f} % of its planning" if effort[name] < float("inf") else "")
            for name in choosing
        ]
        rewards = ", ".join(f"{name} {reward[name]:.2f}" for name in (cheapest, best, *choosing))
        gain = f"The gain is {gains.mean():.2f} ({low:.2f}, {high:.2f})"
        return f"{'; '.join(shares)}. {gain}; reward per step: {rewards}. {_collisions(rows)}"
    text = f"Planning every step with {best} earns a reward of {reward[best]:.2f} per step"
    if best == cheapest:
        text += ", and no more expensive model earns more in these episodes" if len(fixed) > 1 else ""
    else:
        text += f", with {cheapest} {reward[cheapest]:.2f}"
        if len(gains) < 2:
            text += "; one episode cannot show that it is better"
        elif not low > 0:
            difference = f"difference {gains.mean():.2f}, 90 % interval {low:.2f} to {high:.2f}"
            text += f", but {len(gains)} episodes do not show that it is better ({difference})"
    sentences = [text]
    for name in choosing:
        text, share = f"{name} earns {reward[name]:.2f}", counted[name] / counted[best]
        sentences.append(text + (f" with {100 * share:.0f} % of {best}'s planning" if share < float("inf") else ""))
    return " ".join([*(f"{sentence}." for sentence in sentences), _collisions(rows)])


def _collisions(rows: pd.DataFrame) -> str:
    """Say who collides, and how often."""
    hit = rows[rows["collision_episodes"] > 0]
    if hit.empty:
        return "No controller collides."
    worst = hit.loc[hit["collision_episodes"].idxmax()]
    *names, last = hit.index
    who = f"{', '.join(names)} and {last}" if names else last
    who = "every controller" if len(hit) == len(rows) > 1 else who
    most = f"{worst['collision_episodes']} of {worst['episodes']}"
    return f"There are collisions with {who}, in {'up to ' if names else ''}{most} episodes."


def in_order(scenarios: Iterable[str]) -> list[str]:
    """Order scenarios for texts: Merger, Give Way, then the others as given."""
    return sorted(scenarios, key=lambda name: FIRST.index(name) if name in FIRST else len(FIRST))
