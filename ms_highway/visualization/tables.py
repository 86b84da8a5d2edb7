"""Tables of texts, to be printed or written."""

from collections.abc import Iterable, Iterator, Mapping
from copy import copy
from textwrap import wrap
from typing import Any

import pandas as pd
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from ms_highway.experiments.analysis.regret import remarks

HEADING_WIDTH, NAME_WIDTH = 6, 32  # characters, after which headings of narrow columns and long names are wrapped
SHORT_NAME_WIDTH = 13  # characters, to which names are wrapped where there is no room
MOST_WIDTH = 10_000  # characters


def grid(title: str, rows: Iterable[Mapping[Any, str]], left: int = 1) -> Table:
    """Return a table to be printed.

    Args:
        title: above it.
        rows: texts by heading, the same headings in each.
        left: how many of the first columns are names; all others are numbers, flush right.
    """
    texts = list(rows)
    table = Table(title=title, box=SIMPLE, title_style="bold", collapse_padding=True, pad_edge=False)
    table.title_justify = table.caption_justify = "left"
    for place, heading in enumerate(texts[0]):
        width = max(HEADING_WIDTH, *(len(row[heading]) for row in texts))
        lines = wrap(heading.replace("/step", " /step"), width, break_long_words=False)
        if place < left:
            least = min(width, SHORT_NAME_WIDTH)
            table.add_column("\n".join(lines), overflow="fold", min_width=least, max_width=NAME_WIDTH)
        else:
            least = max(len(text) for text in (*lines, *(row[heading] for row in texts)))
            table.add_column("\n".join(lines), justify="right", no_wrap=True, min_width=least)
    for row in texts:
        table.add_row(*row.values())
    return table


def fitting(table: Table, console: Console) -> Iterator[Table]:
    """Yield a table, or where a console is too narrow, its columns in several tables, each with those of the names."""
    names = [column for column in table.columns if column.justify == "left"]
    part, unbounded = copy(table), console.options.update(width=MOST_WIDTH)
    part.columns = list(names)
    for column in table.columns[len(names) :]:
        wider = copy(part)
        wider.columns = [*part.columns, column]
        if len(part.columns) > len(names) and console.measure(wider, options=unbounded).minimum > console.width:
            part.caption = None  # which is below the last
            yield part
            wider.title, wider.columns = None, [*names, column]
        part = wider
    yield part


def two_digits(value: float) -> str:
    """Return a number of at most two significant digits below 10, and without decimals from there on."""
    return f"{value:.2g}" if abs(value) < 10 else f"{value:.0f}"


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
                "counted ms": two_digits(1e3 * row["counted_seconds"]),
                "meta-reward": f"{row['meta_reward']:.3f}",
                "regret": f"{row['regret']:.3f}",
                "90 % interval": f"{row['regret_low']:.3f}, {row['regret_high']:.3f}".replace("nan, nan", ""),
            }
            for name, remark in remarks(rows, scenario, price).items()
            for row in [own.loc[name]]
        ]
        tables.append(grid(f"{scenario}, a second of planning costs {price:g}", texts, 2))
    return tables
