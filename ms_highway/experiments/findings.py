"""What a comparison has found, in a few sentences that are made of its numbers."""

from collections.abc import Iterable, Sequence

import pandas as pd

from ms_highway.experiments.selection import telling_pair
from ms_highway.experiments.summary import interval

__all__ = ["answer", "in_order", "listed"]

FIRST = "merger", "give_way"


def answer(records: pd.DataFrame, summaries: pd.DataFrame, scenario: str) -> str:
    """What the best fixed model gains over the cheapest, how much of it switching keeps, and who collides.

    Whether a gain is more than chance is told from its 90 % interval over the starts that both drove from.

    Args:
        records: a row per step, see `ms_highway.experiments.records.columns`.
        summaries: of `ms_highway.experiments.summary.summary`.
        scenario: its name.
    """
    rows = summaries[summaries["scenario"] == scenario].set_index("controller")
    fixed, seen = rows[rows["kind"] == "fixed"], telling_pair(summaries, scenario)
    told = []
    if len(fixed):
        best, cheapest = str(fixed["reward"].idxmax()), str(fixed["counted_ms"].fillna(float("inf")).idxmin())
        gains = _gains(records[records["scenario"] == scenario], best, cheapest)
        told.append(_fixed(fixed, best, cheapest, gains))
        told += [
            _switching(rows, name, best, cheapest if interval(gains)[0] > 0 else None)
            for name in seen
            if rows["kind"][name] == "switching"
        ]
    else:
        told += [f"{name} earns a reward of {rows['reward'][name]:.2f} per step." for name in seen]
    return " ".join([*told, _collisions(rows)])


def in_order(scenarios: Iterable[str]) -> list[str]:
    """Scenarios as people are told of them: those first in which models differ most plainly, then as they come."""
    return sorted(scenarios, key=lambda name: FIRST.index(name) if name in FIRST else len(FIRST))


def listed(names: Sequence[str]) -> str:
    """Names in a row, as in a sentence."""
    return " and ".join([part for part in (", ".join(names[:-1]), names[-1]) if part])


def _gains(records: pd.DataFrame, one: str, other: str) -> pd.Series:
    """What an episode with one controller earns more than with another, by the seeds that both have driven."""
    earned = records.groupby(["controller", "seed"])["reward"].mean().unstack("controller")
    return (earned[one] - earned[other]).dropna()


def _fixed(fixed: pd.DataFrame, best: str, cheapest: str, gains: pd.Series) -> str:
    """What planning every step with the same model earns."""
    told = f"Planning every step with {best} earns a reward of {fixed['reward'][best]:.2f} per step"
    if best == cheapest:
        return told + (", and no dearer model earns more in these episodes." if len(fixed) > 1 else ".")
    told += f", with {cheapest} {fixed['reward'][cheapest]:.2f}"
    low, high = interval(gains)
    if low > 0:
        return told + "."
    if len(gains) < 2:
        return told + "; one episode cannot show that it is better."
    difference = f"difference {gains.mean():.2f}, 90 % interval {low:.2f} to {high:.2f}"
    return told + f", but {len(gains)} episodes do not show that it is better ({difference})."


def _switching(rows: pd.DataFrame, name: str, best: str, cheapest: str | None) -> str:
    """What switching earns and counts beside the best fixed model, and where that gains, over the cheapest one."""
    told = f"{name} earns {rows['reward'][name]:.2f}"
    if cheapest is not None:
        gain, whole = (rows["reward"][one] - rows["reward"][cheapest] for one in (name, best))
        told += f", {100 * gain / whole:.0f} % of that gain,"
    planning = rows["counted_ms"][name] / rows["counted_ms"][best]
    return told + (f" with {100 * planning:.0f} % of {best}'s planning." if planning < float("inf") else ".")


def _collisions(rows: pd.DataFrame) -> str:
    hit = rows[rows["collision_episodes"] > 0]
    if hit.empty:
        return "No controller collides."
    worst = hit.loc[hit["collision_episodes"].idxmax()]
    who = "every controller" if len(hit) == len(rows) > 1 else listed(list(hit.index))
    most = f"{worst['collision_episodes']} of {worst['episodes']}"
    return f"There are collisions with {who}, in {'up to ' if len(hit) > 1 else ''}{most} episodes."
