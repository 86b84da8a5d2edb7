"""Tables of texts, to be printed or written."""

from collections.abc import Iterable, Mapping
from textwrap import wrap
from typing import Any

import pandas as pd
from rich.box import SIMPLE
from rich.table import Table

from ms_highway.experiments.analysis.regret import remarks

HEADING_WIDTH, NAME_WIDTH = 11, 32  # characters, after which headings of narrow columns and long names are wrapped


def grid(title: str, rows: Iterable[Mapping[Any, str]], left: int = 1) -> Table:
    """Return a table to be printed.

    Args:
        title: above it.
        rows: texts by heading, the same headings in each.
        left: how many of the first columns are names; all others are numbers, flush right.
    """
    texts, table = list(rows), Table(title=title, box=SIMPLE, title_justify="left", title_style="bold")
    for place, heading in enumerate(texts[0]):
        lines = wrap(heading, max(HEADING_WIDTH, *(len(row[heading]) for row in texts)))
        if place < left:
            table.add_column("\n".join(lines), overflow="fold", max_width=NAME_WIDTH)
        else:
            table.add_column("\n".join(lines), justify="right", no_wrap=True)
    for row in texts:
        table.add_row(*row.values())
    return table


def markdown(table: pd.DataFrame) -> str:
    """Return a table of texts in Markdown."""
    lines = [list(table), ["---"] * table.shape[1], *table.to_numpy().tolist()]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def regret_tables(behind: pd.DataFrame, scenario: str) -> list[Table]:
    """Return regrets per step in one scenario, a table per price, of the controllers that `remarks` selects.

    Args:
        behind: rows of `ms_highway.experiments.analysis.regret.regrets`, with columns ``scenario`` and ``price``.
        scenario: its name.
    """
    tables = []
    for price, rows in behind.groupby("price", sort=False):
        own = rows.query("scenario == @scenario").set_index("controller")
        texts = [
            {
                "controller": name,
                "": remark,
                "reward": f"{row['reward']:.2f}",
                "counted ms": f"{1e3 * row['counted_seconds']:.0f}",
                "meta-reward": f"{row['meta_reward']:.3f}",
                "regret": f"{row['regret']:.3f}",
                "90 % interval": f"{row['regret_low']:.3f}, {row['regret_high']:.3f}".replace("nan, nan", ""),
            }
            for name, remark in remarks(rows, scenario, price).items()
            for row in [own.loc[name]]
        ]
        tables.append(grid(f"{scenario}, a second of planning costs {price:g}", texts, 2))
    return tables
