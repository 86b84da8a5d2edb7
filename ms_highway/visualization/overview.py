"""Set comparisons in one table, beside each other and beside what the paper published."""

from collections.abc import Sequence

import pandas as pd

from ms_highway.experiments.analysis.published import Published
from ms_highway.experiments.results import Results
from ms_highway.visualization.comparison import cells

__all__ = ["markdown", "overview"]

OUTCOME = "reward/step", "90 % interval", "collisions"
DISTINGUISHING = ("semantics", "human_reward", "solver", "costs")
PUBLISHED = ["published", "published ms"]
PAGE_ONLY = ["counted ms", PUBLISHED[1]]


def overview(results: Sequence[Results]) -> pd.DataFrame:
    """Return texts, a row per scenario and controller of any of the results, those of the first ones first.

    Columns: ``scenario`` and ``controller``; of every directory the reward per step with its interval and the episodes
    with a collision, headed by what distinguishes it from the others; of the first also times and shares of models;
    and where one of them may be compared with the paper's, its reward and computing time. A cell is empty where a
    directory has no such episodes.

    Raises:
        ValueError: if two of the directories are the same.
    """
    if len({result.directory.resolve() for result in results}) < len(results):
        raise ValueError("a directory is named twice; name each once")
    found = [_by_controller(result) for result in results]
    rows = []
    for key in dict.fromkeys(key for texts in found for key in texts):
        row = dict(zip(("scenario", "controller"), key, strict=True))
        for name, texts in zip(_names(results), found, strict=True):
            row |= _outcome(texts.get(key), name)
        row |= {name: text for name, text in found[0].get(key, {}).items() if name not in (*OUTCOME, "controller")}
        rows.append(row | _published(results, *key))
    table = pd.DataFrame(rows).fillna("")  # where one scenario has fallbacks, and another none
    return table if table[PUBLISHED[0]].any() else table.drop(columns=PUBLISHED)


def markdown(table: pd.DataFrame) -> str:
    """Return an `overview` as a table in Markdown, without the columns that need more explanation."""
    table = table.drop(columns=PAGE_ONLY, errors="ignore")
    lines = [list(table), ["---"] * table.shape[1], *table.to_numpy().tolist()]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _by_controller(result: Results) -> dict[tuple[str, str], dict[str, str]]:
    """Return the texts of a comparison's cells by scenario and controller."""
    return {
        (scenario, row["controller"]): row
        for scenario in result.scenarios
        for row in cells(result.summaries, scenario).to_dict("records")
    }


def _outcome(row: dict[str, str] | None, name: str) -> dict[str, str]:
    headings = f"reward per step (90 % interval){name}", f"episodes with a collision{name}"
    if row is None:
        return dict.fromkeys(headings, "")
    reward, interval, collisions = (row[name] for name in OUTCOME)
    return dict(zip(headings, (f"{reward} ({interval})", collisions), strict=True))


def _published(results: Sequence[Results], scenario: str, controller: str) -> dict[str, str]:
    known: list[Published] = [one for result in results if (one := result.published(scenario, controller))]
    texts = [f"{known[0].reward:.2f}", f"{1e3 * known[0].seconds:.0f}"] if known else ["", ""]
    return dict(zip(PUBLISHED, texts, strict=True))


def _names(results: Sequence[Results]) -> list[str]:
    """Name each by the first settings that distinguish all, else by its directory; a single one has no name."""
    if len(results) == 1:
        return [""]
    names: list[list[str]] = [[] for _ in results]
    for key in DISTINGUISHING:
        values = [result.settings.get(key) for result in results]
        if any(value != values[0] for value in values):
            for name, value in zip(names, values, strict=True):
                name.append(f"{value if isinstance(value, str) else 'given'} {key.replace('_', ' ')}")
        if len({tuple(name) for name in names}) == len(results):
            return [", " + ", ".join(name) for name in names]
    return [f", {result.directory}" for result in results]
