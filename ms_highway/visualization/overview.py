"""Set comparisons in one table, beside each other and beside what the paper published."""

from collections.abc import Sequence
from itertools import chain
from typing import Any

import pandas as pd

from ms_highway.experiments.directory import EXTENDED
from ms_highway.experiments.results import Results
from ms_highway.visualization.comparison import cells

OUTCOME = "controller", "reward/step", "90 % interval", "collisions"
DISTINGUISHING = ("semantics", "human_reward", "solver", "costs")
EXPLAINED = ["counted ms", "published ms"]


def overview(results: Sequence[Results], explained: bool = False) -> pd.DataFrame:
    """Return texts, a row per scenario and controller of any of the results, those of the first ones first.

    Columns: ``scenario`` and ``controller``; of every directory the reward per step with its interval and the episodes
    with a collision, headed by what distinguishes it from the others; of the first also times and shares of models;
    and where one of them may be compared with the paper's, its reward and computing time. A cell is empty where a
    directory has no such episodes.

    Args:
        results: of comparisons.
        explained: whether the table has the columns that need an explanation.

    Raises:
        ValueError: if two of the directories are the same.
    """
    if len({result.directory.resolve() for result in results}) < len(results):
        raise ValueError("a directory is named twice; name each once")
    names, rows = _names(results), []
    found = [
        {
            (scenario, row["controller"]): row
            for scenario in one.scenarios
            for row in cells(one.summaries, scenario).to_dict("records")
        }
        for one in results
    ]
    for key in dict.fromkeys(chain(*found)):
        row = dict(zip(("scenario", "controller"), key, strict=True))
        for name, texts in zip(names, found, strict=True):
            own = texts.get(key)
            outcome = (f"{own['reward/step']} ({own['90 % interval']})", own["collisions"]) if own else ("", "")
            headings = f"reward per step (90 % interval){name}", f"episodes with a collision{name}"
            row |= dict(zip(headings, outcome, strict=True))
        row |= {heading: text for heading, text in found[0].get(key, {}).items() if heading not in OUTCOME}
        for published in [one for result in results if (one := result.published(*key))][:1]:
            row |= {"published": f"{published.reward:.2f}", "published ms": f"{1e3 * published.seconds:.0f}"}
        rows.append(row)
    table = pd.DataFrame(rows).fillna("")  # where one scenario has fallbacks, and another none
    return table if explained else table.drop(columns=EXPLAINED, errors="ignore")


def _names(results: Sequence[Results]) -> list[str]:
    """Name each by the first settings that distinguish all, else by its directory; a single one has no name."""
    if len(results) == 1:
        return [""]
    settings = [result.settings for result in results]
    every = [key for key in dict.fromkeys(chain(DISTINGUISHING, *settings)) if key not in EXTENDED]
    differing = [key for key in every if any(one.get(key) != settings[0].get(key) for one in settings)]
    for count in range(1, len(differing) + 1):
        keys = differing[:count]
        names = [
            ", ".join(["", *(f"{_text(one.get(key))} {key.replace('_', ' ')}" for key in keys)]) for one in settings
        ]
        if len(set(names)) == len(results):
            return names
    return [f", {result.directory}" for result in results]


def _text(value: Any) -> str:
    """Return a value of a setting as part of a name."""
    if isinstance(value, list):
        return " and ".join(map(_text, value))
    return "usual" if value is None else "given" if isinstance(value, dict) else str(value)
