"""Say in a few sentences what the numbers of a comparison show."""

from collections.abc import Iterable, Sequence

import pandas as pd

from ms_highway.experiments.analysis.selection import choosing_controllers, telling_pair
from ms_highway.experiments.analysis.summary import interval

__all__ = ["answer", "in_order", "listed"]

FIRST = "merger", "give_way"


def answer(records: pd.DataFrame, summaries: pd.DataFrame, scenario: str) -> str:
    """Say what the best fixed model gains over the cheapest, how much of it choosing keeps, and who collides.

    A gain counts as more than chance by its 90 % interval over the starts that both drove from.

    Args:
        records: a row per step, see `ms_highway.experiments.records.columns`.
        summaries: of `ms_highway.experiments.analysis.summary.summary`.
        scenario: its name.
    """
    rows = summaries[summaries["scenario"] == scenario].set_index("controller")
    fixed, sentences = rows[rows["kind"] == "fixed"], []
    if len(fixed):
        best, cheapest = str(fixed["reward"].idxmax()), str(fixed["counted_ms"].fillna(float("inf")).idxmin())
        gains = _gains(records[records["scenario"] == scenario], best, cheapest)
        sentences.append(_fixed(fixed, best, cheapest, gains))
        sentences += [
            _choosing(rows, name, best, cheapest if interval(gains)[0] > 0 else None)
            for name in choosing_controllers(summaries, scenario)
        ]
    else:
        sentences += [
            f"{name} earns a reward of {rows['reward'][name]:.2f} per step."
            for name in telling_pair(summaries, scenario)
        ]
    return " ".join([*sentences, _collisions(rows)])


def in_order(scenarios: Iterable[str]) -> list[str]:
    """Order scenarios for texts: Merger, Give Way, then the others as given."""
    return sorted(scenarios, key=lambda name: FIRST.index(name) if name in FIRST else len(FIRST))


def listed(names: Sequence[str]) -> str:
    """Join names as in a sentence."""
    return " and ".join([part for part in (", ".join(names[:-1]), names[-1]) if part])


def _gains(records: pd.DataFrame, one: str, other: str) -> pd.Series:
    """Return what one controller earns more than another, by the seeds that both have driven."""
    earned = records.groupby(["controller", "seed"])["reward"].mean().unstack("controller")
    return (earned[one] - earned[other]).dropna()


def _fixed(fixed: pd.DataFrame, best: str, cheapest: str, gains: pd.Series) -> str:
    """Say what planning every step with the same model earns."""
    text = f"Planning every step with {best} earns a reward of {fixed['reward'][best]:.2f} per step"
    if best == cheapest:
        return text + (", and no dearer model earns more in these episodes." if len(fixed) > 1 else ".")
    text += f", with {cheapest} {fixed['reward'][cheapest]:.2f}"
    low, high = interval(gains)
    if low > 0:
        return text + "."
    if len(gains) < 2:
        return text + "; one episode cannot show that it is better."
    difference = f"difference {gains.mean():.2f}, 90 % interval {low:.2f} to {high:.2f}"
    return text + f", but {len(gains)} episodes do not show that it is better ({difference})."


def _choosing(rows: pd.DataFrame, name: str, best: str, cheapest: str | None) -> str:
    """Say what choosing earns and counts beside the best fixed model, and over the cheapest one if that gains."""
    text = f"{name} earns {rows['reward'][name]:.2f}"
    if cheapest is not None:
        gain, whole = (rows["reward"][one] - rows["reward"][cheapest] for one in (name, best))
        text += f", {100 * gain / whole:.0f} % of that gain,"
    planning = rows["counted_ms"][name] / rows["counted_ms"][best]
    return text + (f" with {100 * planning:.0f} % of {best}'s planning." if planning < float("inf") else ".")


def _collisions(rows: pd.DataFrame) -> str:
    hit = rows[rows["collision_episodes"] > 0]
    if hit.empty:
        return "No controller collides."
    worst = hit.loc[hit["collision_episodes"].idxmax()]
    who = "every controller" if len(hit) == len(rows) > 1 else listed(list(hit.index))
    most = f"{worst['collision_episodes']} of {worst['episodes']}"
    return f"There are collisions with {who}, in {'up to ' if len(hit) > 1 else ''}{most} episodes."
