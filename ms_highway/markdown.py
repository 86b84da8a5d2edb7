"""A comparison as a table in Markdown, of one directory of results or of several beside each other."""

from collections.abc import Sequence
from typing import Any

from ms_highway.published import PUBLISHED
from ms_highway.results import Results

__all__ = ["markdown_table"]

DISTINGUISHING = ("semantics", "human_reward", "solver", "costs")


def markdown_table(results: Sequence[Results]) -> str:
    """A row per scenario and controller of the first results.

    Columns: of every directory the reward per step with its interval and the episodes with a collision, headed by what
    distinguishes it from the others; of the first also times and shares of models; the paper's reward where it
    published one. A cell is empty where a directory has no such episodes.

    Raises:
        ValueError: if two of the directories are the same.
    """
    if len({result.directory.resolve() for result in results}) < len(results):
        raise ValueError("a directory is named twice; name each once")
    first, names = results[0].summaries.to_dict("records"), _names(results)
    found = [{(row["scenario"], row["controller"]): row for row in r.summaries.to_dict("records")} for r in results]
    models = [name.removeprefix("share_") for name in results[0].summaries if name.startswith("share_")]
    headings = ["scenario", "controller"]
    for name in names:
        headings += [f"reward per step (90 % interval){name}", f"episodes with a collision{name}"]
    headings += ["planning ms", "deciding ms", " / ".join(models) + " %", "published"]
    lines = [headings, ["---"] * len(headings)]
    for row in first:
        key = row["scenario"], row["controller"]
        cells = list(key)
        for rows in found:
            cells += _outcome(rows[key]) if key in rows else ["", ""]
        shares = " / ".join(f"{100 * row[f'share_{model}']:.0f}" for model in models)
        published = f"{PUBLISHED[key].reward:.2f}" if key in PUBLISHED else ""
        lines.append([*cells, f"{row['planning_ms']:.2f}", f"{row['decision_ms']:.2f}", shares, published])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _outcome(row: dict[str, Any]) -> list[str]:
    interval = f" ({row['reward_low']:.2f}, {row['reward_high']:.2f})" if row["episodes"] > 1 else ""
    return [f"{row['reward']:.2f}{interval}", f"{row['collision_episodes']} of {row['episodes']}"]


def _names(results: Sequence[Results]) -> list[str]:
    """What to call each: the first settings that tell all apart, else the directories; nothing where there is one."""
    if len(results) == 1:
        return [""]
    told: list[list[str]] = [[] for _ in results]
    for key in DISTINGUISHING:
        values = [result.settings.get(key) for result in results]
        if any(value != values[0] for value in values):
            for name, value in zip(told, values, strict=True):
                name.append(f"{value if isinstance(value, str) else 'given'} {key.replace('_', ' ')}")
        if len({tuple(name) for name in told}) == len(results):
            return [", " + ", ".join(name) for name in told]
    return [f", {result.directory}" for result in results]
